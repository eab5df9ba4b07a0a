"""The telescope pupil as a drawing: outline, central hole and vanes, in metres."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Vane:
    """A straight bar of the spider from `start_m` to `end_m` (x, y), of full width `width_m` [m]."""

    start_m: tuple[float, float]
    end_m: tuple[float, float]
    width_m: float


@dataclass(frozen=True)
class PupilGeometry:
    """Outline of an obscured circular pupil [m]."""

    diameter_m: float
    obscuration_m: float = 0.0
    vanes: tuple[Vane, ...] = ()
