"""Experiment `exposures`: its science, its stage and its section of the report."""
