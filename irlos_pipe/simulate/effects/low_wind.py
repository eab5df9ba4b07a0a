"""`low_wind_effect`: wavefront steps between the petals of the pupil, which calm nights bring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane
from irlos_pipe.simulate.effects.base import PupilEffect
from irlos_pipe.simulate.errors import SceneError

FIRST_PETAL_DEG = 45.0


@dataclass(frozen=True)
class LowWindEffect(PupilEffect):
    """Piston, tip and tilt of the petals.

    Attributes
    ----------
    piston_nm, tip_nm, tilt_nm : sequence of float, optional
        One value per petal each, anticlockwise from the one on the +45° diagonal; tip and tilt are Noll 2
        and 3 of the whole pupil, restricted to the petal.
    """

    name = "low_wind_effect"
    piston_nm: Sequence[float] | None = None
    tip_nm: Sequence[float] | None = None
    tilt_nm: Sequence[float] | None = None

    def steps_nm(self, geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """See `PupilEffect.steps_nm`.

        Raises
        ------
        SceneError
            For another number of values than petals.
        """
        index, radius_m = petal_index(geometry, x_m, y_m), geometry.diameter_m / 2
        petals = len(geometry.vanes)
        piston, tip, tilt = (
            self._per_petal(key, petals)[index] for key in ("piston_nm", "tip_nm", "tilt_nm")
        )
        return piston + 2 / radius_m * (tip * x_m + tilt * y_m)

    def _per_petal(self, key: str, petals: int) -> np.ndarray:
        given = getattr(self, key)
        values = np.zeros(petals) if given is None else np.asarray(given, float)
        if values.shape != (petals,):
            raise SceneError(
                f"effects.low_wind_effect.{key}: the pupil has {petals} petals; give as many values"
            )
        return values


def petal_index(geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return the number of the petal at every point, counted anticlockwise from the one on the +45° diagonal.

    Petals meet at the middle of the vanes, each seen as a line from its origin outwards.

    Parameters
    ----------
    geometry : PupilGeometry
    x_m, y_m : ndarray, shapes that broadcast
        Points in the pupil.

    Raises
    ------
    SceneError
        For a pupil with fewer than two vanes.
    """
    vanes = sorted(geometry.vanes, key=lambda vane: np.arctan2(vane.end_m[1], vane.end_m[0]) % (2 * np.pi))
    if len(vanes) < 2:
        raise SceneError(f"low_wind_effect: needs petals, but the pupil has {len(vanes)} vanes; leave it out")
    first = int(_after_vane(vanes, *_point_on(FIRST_PETAL_DEG, geometry.diameter_m / 2)))
    return (_after_vane(vanes, x_m, y_m) - first) % len(vanes)


def _point_on(angle_deg: float, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    angle = np.deg2rad(angle_deg)
    return np.asarray(radius_m * np.cos(angle)), np.asarray(radius_m * np.sin(angle))


def _after_vane(vanes: list[Vane], x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Which vane one meets first going clockwise along the circle through each point."""
    radius, angle = np.hypot(x_m, y_m), np.arctan2(y_m, x_m)
    gaps = [(angle - _vane_angle(vane, radius)) % (2 * np.pi) for vane in vanes]
    return np.argmin(gaps, axis=0)


def _vane_angle(vane: Vane, radius_m: np.ndarray) -> np.ndarray:
    """Polar angle at which the vane's line crosses circles about the axis [rad]."""
    start, end = complex(*vane.start_m), complex(*vane.end_m)
    direction = (end - start) / abs(end - start)
    forward = (start * direction.conjugate()).real
    along = -forward + np.sqrt(np.maximum(forward**2 - abs(start) ** 2 + radius_m**2, 0.0))
    return np.angle(start + along * direction)
