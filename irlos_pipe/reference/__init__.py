"""What stages, keys, effects, checks and numbers mean, told from the places that define them."""
