"""Stage `derotator`: NCPAs before and after the derotator."""
