"""Experiment `ramp_conditions`: its science, its stage and its section of the report."""
