"""Experiment `mode_statistics`: its science, its stage and its section of the report."""
