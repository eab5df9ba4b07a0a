"""Effects on where light passes the pupil: `pupil_misregistration` and `amplitude_aberration`."""

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
