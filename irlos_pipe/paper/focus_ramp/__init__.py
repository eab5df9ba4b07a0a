"""Experiment `focus_ramp`: its science, its stage and its section of the report."""
