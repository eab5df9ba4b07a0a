"""Atmospheric dispersion as it is known of a recording: altitude, air, and direction of the zenith.

    displacement(λ) = A(λ) tan z + B(λ) tan³ z

towards the zenith, with the constants of IAU SOFA's ``refco``: Saastamoinen's model of the atmosphere, and
the refractivity of air of IAG 1999.
"""

from __future__ import annotations

import erfa
import numpy as np

from irlos_pipe.conventions.units import MAS_PER_RAD
from irlos_pipe.effects.declaration import Refraction
from irlos_pipe.effects.public_values import components
from irlos_pipe.frames.recording import Acquisition

UNKNOWN_MAS_PER_UM = 300.0  # what nothing corrects 60° from the zenith, at 1.4 µm
UNSURE, LEAST_MAS_PER_UM = 0.1, 5.0  # part of what is computed that may be wrong, and at least
LEFT = 0.2  # part that a corrector may leave
STEP_UM = 0.01
LOWEST_DEG = 10.0  # beyond it the formula errs


def refraction_of(acquisition: Acquisition, mean_um: float) -> Refraction:
    """Return what is to be expected of dispersion at the mean wavelength of a recording.

    Parameters
    ----------
    acquisition : Acquisition
    mean_um : float
        Mean wavelength [µm].
    """
    size = _size_mas_per_um(acquisition, mean_um)
    if size is None:
        return Refraction((0.0, 0.0), UNKNOWN_MAS_PER_UM)
    if acquisition.dispersion_corrected:
        return Refraction((0.0, 0.0), LEFT * size + LEAST_MAS_PER_UM)
    if acquisition.zenith_angle_deg is None:
        return Refraction((0.0, 0.0), max(size, UNKNOWN_MAS_PER_UM))
    x, y = components(size, acquisition.zenith_angle_deg + 180)  # longer waves lie away from the zenith
    return Refraction((x, y), UNSURE * size + LEAST_MAS_PER_UM)


def _size_mas_per_um(acquisition: Acquisition, mean_um: float) -> float | None:
    """Return how far refraction moves light per µm at the mean wavelength; None where it is not known."""
    air = acquisition.pressure_hpa, acquisition.temperature_c, acquisition.humidity_percent
    pressure, temperature, humidity = (float("nan") if value is None else value for value in air)
    altitude = acquisition.altitude_deg or 0.0
    if altitude < LOWEST_DEG or not np.isfinite([pressure, temperature, humidity]).all():
        return None
    ends = [
        refraction_mas(altitude, pressure, temperature, humidity, mean_um + step)
        for step in (-STEP_UM, STEP_UM)
    ]
    return (ends[0] - ends[1]) / (2 * STEP_UM)


def refraction_mas(
    altitude_deg: float,
    pressure_hpa: float,
    temperature_c: float,
    humidity_percent: float,
    wavelength_um: float,
) -> float:
    """Return by how much light of one wavelength is raised towards the zenith [mas].

    Parameters
    ----------
    altitude_deg : float
        At least `LOWEST_DEG`.
    pressure_hpa, temperature_c, humidity_percent : float
        Of the air at the telescope.
    wavelength_um : float
    """
    a, b = erfa.refco(pressure_hpa, temperature_c, humidity_percent / 100, wavelength_um)
    tangent = np.tan(np.pi / 2 - np.deg2rad(altitude_deg))
    return float((a * tangent + b * tangent**3) * MAS_PER_RAD)
