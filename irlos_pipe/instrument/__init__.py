"""Instrument profiles: telescope, detector and AO system as data."""
