"""Solvers, losses and derivatives; nothing here knows physics."""
