"""Stage `correct`: modal offsets, and what they would do to the image."""
