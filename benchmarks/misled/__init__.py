"""Plausible but wrong inputs, and right ones: which of them a reduction accuses, and which mislead it."""
