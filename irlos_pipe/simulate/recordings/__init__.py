"""Simulated observations: a spec becomes the files of the instrument, and the truth next to them."""
