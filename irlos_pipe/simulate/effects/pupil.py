"""Effects on where light passes the pupil, and steps of the wavefront between its parts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from irlos_pipe.conventions.keys import key
from irlos_pipe.conventions.pupil_drawing import PupilGeometry, turned, with_sizes
from irlos_pipe.simulate.aperture import petal_count, petal_index, segment_count, segment_index
from irlos_pipe.simulate.effects.base import SimulatedEffect
from irlos_pipe.simulate.telescope import Telescope


@dataclass(frozen=True)
class PupilMisregistration(SimulatedEffect):
    """An internal stop displaced by (`dx_m`, `dy_m`), and the vanes turned by `rotation_deg`."""

    name = "pupil_misregistration"
    dx_m: float = key(0.0, ge=-2.0, le=2.0)
    dy_m: float = key(0.0, ge=-2.0, le=2.0)
    rotation_deg: float = key(0.0, ge=-720.0, le=720.0)

    @property
    def stop_m(self) -> tuple[float, float] | None:
        return (self.dx_m, self.dy_m) if self.dx_m or self.dy_m else None

    def built(self, geometry: PupilGeometry) -> PupilGeometry:
        return turned(geometry, self.rotation_deg)


@dataclass(frozen=True)
class PupilSizes(SimulatedEffect):
    """A central obscuration of `obscuration_m`, and vanes `vane_width_m` wide on average."""

    name = "pupil_geometry"
    obscuration_m: float | None = None
    vane_width_m: float | None = None

    def built(self, geometry: PupilGeometry) -> PupilGeometry:
        return with_sizes(geometry, obscuration_m=self.obscuration_m, vane_width_m=self.vane_width_m)


@dataclass(frozen=True)
class AmplitudeAberration(SimulatedEffect):
    """Smooth non-uniform transmission: one plus the sum of `zernike`, Noll: relative amplitude."""

    name = "amplitude_aberration"
    zernike: Mapping[int, float]

    def transparency(self, pupil: Telescope) -> np.ndarray:
        return np.maximum(1 + pupil.opd_nm(self.zernike), 0.0)


@dataclass(frozen=True)
class PupilSpot(SimulatedEffect):
    """A disc at (`x_m`, `y_m`) that stops a part `opacity`, half as much at `radius_m` from its centre.

    Its edge is soft: the fourth power of the distance is in an exponential.
    """

    name = "pupil_spot"
    opacity: float = key(ge=0.0, le=1.0)
    x_m: float = key(ge=-10.0, le=10.0)
    y_m: float = key(ge=-10.0, le=10.0)
    radius_m: float = key(ge=1e-3, le=10.0)

    def transparency(self, pupil: Telescope) -> np.ndarray:
        x2, y2 = (pupil.u_m - self.x_m) ** 2, (pupil.u_m - self.y_m) ** 2
        return 1 - self.opacity * 0.5 ** ((x2[None, :] + y2[:, None]) ** 2 / self.radius_m**4)


@dataclass(frozen=True)
class LowWindEffect(SimulatedEffect):
    """Piston, tip and tilt of the petals, which calm nights bring.

    One value per petal each, anticlockwise from the one nearest to the +45° diagonal; tip and tilt are Noll 2
    and 3 of the whole pupil, restricted to the petal.
    """

    name = "low_wind_effect"
    piston_nm: Sequence[float] | None = None
    tip_nm: Sequence[float] | None = None
    tilt_nm: Sequence[float] | None = None

    def misfit(self, scene: Any) -> str:
        """Return why there are not as many values as petals."""
        given = {"piston_nm": self.piston_nm, "tip_nm": self.tip_nm, "tilt_nm": self.tilt_nm}
        return _misfit(self.name, "petals", petal_count(scene.geometry), given)

    def steps_nm(self, geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        index, radius_m = petal_index(geometry, x_m, y_m), geometry.diameter_m / 2
        none = np.zeros(petal_count(geometry))
        piston, tip, tilt = (
            none if values is None else np.asarray(values, float)
            for values in (self.piston_nm, self.tip_nm, self.tilt_nm)
        )
        return piston[index] + 2 / radius_m * (tip[index] * x_m + tilt[index] * y_m)


@dataclass(frozen=True)
class SegmentPiston(SimulatedEffect):
    """Piston of the segments of the pupil, `piston_nm` in the order of their numbers."""

    name = "segment_piston"
    piston_nm: Sequence[float]

    def misfit(self, scene: Any) -> str:
        """Return why there are not as many values as segments."""
        return _misfit(self.name, "segments", segment_count(scene.geometry), {"piston_nm": self.piston_nm})

    def steps_nm(self, geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        return np.asarray(self.piston_nm, float)[segment_index(geometry, x_m, y_m)]


def _misfit(name: str, parts: str, count: int, given: dict[str, Sequence[float] | None]) -> str:
    """What is wrong with lists that should have one value per part of the pupil."""
    if count < 2:
        return f"effects.{name}: the pupil is not divided into {parts}; leave it out"
    wrong = [key for key, values in given.items() if values is not None and len(values) != count]
    return f"effects.{name}.{wrong[0]}: the pupil has {count} {parts}; give as many values" if wrong else ""
