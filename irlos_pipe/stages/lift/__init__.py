"""Stage `lift`: tip, tilt and defocus of a ramp."""
