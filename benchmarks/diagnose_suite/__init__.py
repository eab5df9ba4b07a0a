"""The hidden-effect suite of `diagnose`: recordings with a known secret, and how well it is found out."""
