"""Frames as arrays: recordings, their noise, the detector, bad pixels and cleaning."""
