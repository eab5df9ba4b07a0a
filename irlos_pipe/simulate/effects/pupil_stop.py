"""Effects on where light passes the pupil: its stop, its sizes, its transmission, a dark spot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, turned, with_sizes
from irlos_pipe.simulate.effects.base import PupilEffect, wider
from irlos_pipe.simulate.telescope import Telescope


@dataclass(frozen=True)
class PupilMisregistration(PupilEffect):
    """An internal stop displaced by (`dx_m`, `dy_m`), and the vanes turned by `rotation_deg`."""

    name = "pupil_misregistration"
    dx_m: float = wider(-2.0, 2.0, 0.0)
    dy_m: float = wider(-2.0, 2.0, 0.0)
    rotation_deg: float = wider(-720.0, 720.0, 0.0)

    @property
    def stop_m(self) -> tuple[float, float] | None:
        """See `PupilEffect.stop_m`."""
        return (self.dx_m, self.dy_m) if self.dx_m or self.dy_m else None

    def built(self, geometry: PupilGeometry) -> PupilGeometry:
        """See `PupilEffect.built`."""
        return turned(geometry, self.rotation_deg)


@dataclass(frozen=True)
class PupilSizes(PupilEffect):
    """A central obscuration of `obscuration_m`, and vanes `vane_width_m` wide on average."""

    name = "pupil_geometry"
    obscuration_m: float | None = None
    vane_width_m: float | None = None

    def built(self, geometry: PupilGeometry) -> PupilGeometry:
        """See `PupilEffect.built`."""
        return with_sizes(geometry, obscuration_m=self.obscuration_m, vane_width_m=self.vane_width_m)


@dataclass(frozen=True)
class AmplitudeAberration(PupilEffect):
    """Smooth non-uniform transmission: one plus the sum of `zernike`, Noll: relative amplitude."""

    name = "amplitude_aberration"
    zernike: Mapping[int, float]

    def transparency(self, pupil: Telescope) -> np.ndarray:
        """See `PupilEffect.transparency`."""
        return np.maximum(1 + pupil.opd_nm(self.zernike), 0.0)


@dataclass(frozen=True)
class PupilSpot(PupilEffect):
    """A disc at (`x_m`, `y_m`) that stops a part `opacity`, half as much at `radius_m` from its centre.

    Its edge is soft: the fourth power of the distance is in an exponential.
    """

    name = "pupil_spot"
    opacity: float = wider(0.0, 1.0)
    x_m: float = wider(-10.0, 10.0)
    y_m: float = wider(-10.0, 10.0)
    radius_m: float = wider(1e-3, 10.0)

    def transparency(self, pupil: Telescope) -> np.ndarray:
        """See `PupilEffect.transparency`."""
        x2, y2 = (pupil.u_m - self.x_m) ** 2, (pupil.u_m - self.y_m) ** 2
        return 1 - self.opacity * 0.5 ** ((x2[None, :] + y2[:, None]) ** 2 / self.radius_m**4)
