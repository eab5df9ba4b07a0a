"""Experiment: all methods with the same modes, frames and starts."""
