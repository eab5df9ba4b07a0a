"""Experiment `mode_number`: its science, its stage and its section of the report."""
