"""Experiment `mirror_loop`: its science, its stage and its section of the report."""
