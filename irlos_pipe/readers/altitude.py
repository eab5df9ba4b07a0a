"""Altitude of the telescope, from its header or the airmass."""

from __future__ import annotations

import math

from irlos_pipe.conventions.errors import InputDataError

TOLERANCE = 0.03  # of the airmass: an exposure begins and ends at another one; sec z is within 1 % above 15°


def altitude_deg(altitude: float | None, airmass: float | None, where: str) -> float | None:
    """Return the altitude, from the `airmass` where it is not stated [deg].

    Parameters
    ----------
    altitude : float or None
        As stated [deg].
    airmass : float or None
    where : str
        Begins the message of an error.

    Raises
    ------
    InputDataError
        If the two contradict each other.
    """
    if airmass is None:
        return altitude
    if altitude is None:
        return math.degrees(math.asin(1 / airmass))
    seen = 1 / max(math.sin(math.radians(altitude)), 1e-3)
    if abs(airmass / seen - 1) > TOLERANCE:
        raise InputDataError(
            f"{where} altitude_deg = {altitude:g} means an airmass of {seen:.3g}, but airmass = {airmass:g}; "
            "correct one of them"
        )
    return altitude
