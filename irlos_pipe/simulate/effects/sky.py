"""Effects of air and telescope: image motion within a frame, and an AO residual of another size or shape.

In motion the image runs through the distribution of its positions, which blurs it. Besides, a frame sees a
finite piece of the motion, so that it is displaced a little.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from irlos_pipe.conventions.facility import Facility, VibrationLine
from irlos_pipe.conventions.keys import key
from irlos_pipe.simulate import SceneError, require_known
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.effects.base import SimulatedEffect
from irlos_pipe.simulate.motion import MotionBlur

JITTER_CORRELATION_S = 0.010
FAST_HZ = 20.0  # a vibration without a stated frequency is the telescope's strongest line above this
Shape = Literal["sinusoidal", "gaussian"]


@dataclass(frozen=True)
class TipTiltJitter(SimulatedEffect):
    """Isotropic Gaussian motion; the mean of a frame is that of its independent positions."""

    name = "tip_tilt_jitter"
    sigma_mas: float = key(ge=0.0, le=200.0)
    correlation_s: float = key(
        JITTER_CORRELATION_S, "s, time after which the image has moved on", ge=1e-6, le=10.0
    )

    def blur(self, exposure_s: float, lines: Sequence[VibrationLine], rng: np.random.Generator) -> MotionBlur:
        positions = max(exposure_s / self.correlation_s, 1.0)
        mean_mas = self.sigma_mas / np.sqrt(positions) * rng.standard_normal(2)
        return MotionBlur(mean_mas, self.sigma_mas**2 * np.eye(2), np.zeros(2))


@dataclass(frozen=True)
class Vibration(SimulatedEffect):
    """Motion along `angle_deg`, of random phase; what is left of the last period displaces the frame.

    Without `frequency_hz` it is that of the telescope's strongest line above `FAST_HZ`.
    """

    name = "vibration"
    sigma_mas: float = key(ge=0.0, le=200.0)
    angle_deg: float = 0.0
    frequency_hz: float | None = key(
        None, "Hz; the telescope's strongest line above 20 Hz if left out", ge=1e-3, le=1000.0
    )
    shape: Shape = field(default="sinusoidal", metadata={"formerly": "distribution"})

    def __post_init__(self) -> None:
        require_known("effects.vibration.shape", [self.shape], get_args(Shape))

    def blur(self, exposure_s: float, lines: Sequence[VibrationLine], rng: np.random.Generator) -> MotionBlur:
        angle = np.deg2rad(self.angle_deg)
        direction = self.sigma_mas * np.array([np.cos(angle), np.sin(angle)])
        fast = [line for line in lines if line[0] > FAST_HZ]
        if not fast and not self.frequency_hz:
            raise SceneError("effects.vibration: the instrument states no vibration line; give frequency_hz")
        cycles = (self.frequency_hz or max(fast, key=lambda line: line[1] + line[2])[0]) * exposure_s
        mean_mas = np.sqrt(2) * direction * np.sinc(cycles) * np.cos(2 * np.pi * rng.random())
        if self.shape == "gaussian":
            return MotionBlur(mean_mas, np.outer(direction, direction), np.zeros(2))
        return MotionBlur(mean_mas, np.zeros((2, 2)), np.sqrt(2) * direction)


@dataclass(frozen=True)
class SeeingHalo(SimulatedEffect):
    """The residual is larger by the factor `scale`, or `wfe_nm` in total, its spectrum of the same shape.

    On the bench there is none to enlarge: the factor then is one on the residual at the facility's typical
    seeing.
    """

    name = "seeing_halo"
    scale: float | None = None
    wfe_nm: float | None = None

    def __post_init__(self) -> None:
        if (self.scale is None) == (self.wfe_nm is None):
            raise SceneError("effects.seeing_halo: give either scale or wfe_nm")

    def sky(self, sky: Sky | None, facility: Facility) -> Sky | None:
        sky, law = sky or Sky(facility.typical_seeing_arcsec), facility.residual_law
        factor = self.scale if self.wfe_nm is None else self.wfe_nm / sky.total_nm(law)
        return sky.scaled(factor, law) if factor else None


@dataclass(frozen=True)
class UnevenResidual(SimulatedEffect):
    """The variance inside the correction band has `edge`, `side_x` and `side_y` of Noll 4, 2 and 3.

    They are parts of the residual that there is; without one it is the residual at the typical seeing.
    """

    name = "uneven_residual"
    edge: float = 0.0
    side_x: float = 0.0
    side_y: float = 0.0

    def sky(self, sky: Sky | None, facility: Facility) -> Sky | None:
        variance = {4: self.edge, 2: self.side_x, 3: self.side_y}
        return replace(sky or Sky(facility.typical_seeing_arcsec), variance_zernike=variance)
