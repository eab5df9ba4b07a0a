"""Defocus of one image at a time, quickly and with a verdict: what a closed loop measures with."""
