"""Stage `sensitivity`: how faint a star may be."""
