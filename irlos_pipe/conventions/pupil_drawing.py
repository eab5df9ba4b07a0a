"""The telescope pupil as a drawing: outline, central hole and vanes, in metres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

PETALS = 4  # of the pupil that effects of petals are stated for: one between every two vanes


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


def with_vanes_turned(geometry: PupilGeometry, angle_deg: float) -> PupilGeometry:
    """Return the pupil `geometry` with its spider turned anticlockwise by `angle_deg` about the axis."""
    return replace(geometry, vanes=tuple(_turned(vane, angle_deg) for vane in geometry.vanes))


def _turned(vane: Vane, angle_deg: float) -> Vane:
    turn = np.exp(1j * np.deg2rad(angle_deg))
    start, end = (complex(*point) * turn for point in (vane.start_m, vane.end_m))
    return Vane((start.real, start.imag), (end.real, end.imag), vane.width_m)
