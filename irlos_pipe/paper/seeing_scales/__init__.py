"""Experiment `seeing_scales`: its science, its stage and its section of the report."""
