"""Conversions between the units of the interfaces and SI."""

from __future__ import annotations

import math

NM = 1e-9  # one nanometre [m]
MAS = math.pi / 180 / 3600e3  # one milliarcsecond [rad]


def resolution_px(wavelength_m: float, diameter_m: float, pixel_scale_mas: float) -> float:
    """Return the resolution element λ/D in pixels.

    Parameters
    ----------
    wavelength_m, diameter_m : float
        Wavelength, and diameter of the pupil or of a subaperture [m].
    pixel_scale_mas : float
        Side of a pixel on the sky [mas].
    """
    return wavelength_m / diameter_m / (pixel_scale_mas * MAS)
