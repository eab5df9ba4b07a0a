"""Experiment `derotator_series`: its science, its stage and its section of the report."""
