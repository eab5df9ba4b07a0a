"""Estimators: NCPA calibration, LIFT, elongation prior, bounds and sensitivity."""
