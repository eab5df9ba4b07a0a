"""Stage `diagnose`: what the model of a recording or ramp lacks."""
