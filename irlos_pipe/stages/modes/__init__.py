"""Stage `modes`: strength and number of the modes."""
