"""Stage `prior`: defocus of a ramp from the elongation of its images."""
