"""Experiment `first_tests`: its science, its stage and its section of the report."""
