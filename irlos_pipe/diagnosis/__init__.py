"""Naming what the model of an image lacks: detect, identify, adapt, validate."""
