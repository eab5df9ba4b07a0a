"""Experiment: all methods with the same modes and frames."""
