"""Experiment `correction_gain`: its science, its stage and its section of the report."""
