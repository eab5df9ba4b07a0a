"""Petals of the pupil: what lies between two vanes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PETALS, PupilGeometry, Vane
from irlos_pipe.optics.pupil import band_limited_parts

FIRST_PETAL_RAD = np.pi / 4  # the first petal lies on this diagonal


@lru_cache(maxsize=4)
def petal_amplitudes(geometry: PupilGeometry, samples: int) -> np.ndarray:
    """Return the band-limited amplitude of every petal, (petals, n, n); their sum is that of the pupil.

    `geometry` and `samples` are as of `band_limited_pupil`. Petals meet in the middle of the vanes, where
    there is no light: the sharp border costs nothing.

    Raises
    ------
    ValueError
        Unless the pupil has four vanes.
    """
    return band_limited_parts(geometry, samples, lambda x, y: petal_index(geometry, x, y), PETALS)


def petal_index(geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Number of the petal of a `geometry` at points (`x_m`, `y_m`), anticlockwise from the +45° diagonal.

    Raises
    ------
    ValueError
        Unless the pupil has four vanes.
    """
    if len(geometry.vanes) != PETALS:
        raise ValueError(f"the pupil has {len(geometry.vanes)} vanes, but four petals need four")
    vanes = sorted(geometry.vanes, key=lambda vane: np.arctan2(vane.end_m[1], vane.end_m[0]) % (2 * np.pi))
    rim = geometry.diameter_m / 2
    first = _after(vanes, rim * np.cos(FIRST_PETAL_RAD), rim * np.sin(FIRST_PETAL_RAD))
    return (_after(vanes, x_m, y_m) - first) % len(vanes)


def _after(vanes: list[Vane], x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Which vane one meets first going clockwise along the circle through each point."""
    radius, angle = np.hypot(x_m, y_m), np.arctan2(y_m, x_m)
    gaps = [(angle - _angle_at(vane, radius)) % (2 * np.pi) for vane in vanes]
    return np.argmin(gaps, axis=0)


def _angle_at(vane: Vane, radius_m: np.ndarray) -> np.ndarray:
    """Polar angle at which the middle of a vane crosses circles about the axis [rad]."""
    start, end = np.array(vane.start_m), np.array(vane.end_m)
    along = (end - start) / np.hypot(*(end - start))
    forward = start @ along
    distance = np.sqrt(np.maximum(forward**2 - start @ start + radius_m**2, 0)) - forward
    return np.arctan2(start[1] + distance * along[1], start[0] + distance * along[0])
