"""Focal-plane wavefront sensing for the IRLOS sensor of MUSE's narrow-field mode."""

__version__ = "0.2.0"
