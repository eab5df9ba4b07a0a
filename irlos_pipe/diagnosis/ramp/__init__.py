"""Diagnosis of a defocus ramp: what the focus stage really introduced."""
