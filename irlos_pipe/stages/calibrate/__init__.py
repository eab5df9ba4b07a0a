"""Stage `calibrate`: NCPAs from a cube of frames."""
