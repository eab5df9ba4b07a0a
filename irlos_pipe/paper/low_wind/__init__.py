"""Experiment `low_wind`: its science, its stage and its section of the report."""
