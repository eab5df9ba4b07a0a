"""Readers of the input layouts and side-cars: files in, raw recordings out."""
