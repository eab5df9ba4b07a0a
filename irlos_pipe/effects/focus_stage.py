"""What a ramp of focus shows: a stage that misses its offsets, and a beam of high aperture.

`focus_stage_hysteresis`, `focus_stage_offset` and `focus_stage_scale` change the defocus that a ramp really
introduces, and with it what its estimates are compared with.
"""

from dataclasses import replace

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.effects.declaration import Conditions, Parameter, Public
from irlos_pipe.effects.planes import LensEffect, RampEffect
from irlos_pipe.optics.defocus import HIGHEST_SINE
from irlos_pipe.optics.psf_settings import PsfSettings

LEAST_SINE = 0.1  # a focal ratio of 5, below which defocus is the parabola to 0.1 %


def travel_direction(commanded_nm: np.ndarray) -> np.ndarray:
    """+1 or -1 where `commanded_nm` was reached by a rise or fall of it, in order of recording.

    Frames at an unchanged offset keep the direction in which it was reached; 0 before the first move.
    """
    moves = np.sign(np.diff(commanded_nm, prepend=commanded_nm[:1]))
    last_move = np.maximum.accumulate(np.where(moves != 0, np.arange(len(moves)), 0))
    return moves[last_move]


class FocusStageHysteresis(RampEffect):
    """Backlash: an offset reached upwards lies higher, one reached downwards lower, by `nm` each.

    A ramp that changes its direction after every step shows it as a saw-tooth.
    """

    name = "focus_stage_hysteresis"
    formula = "introduced = commanded ± nm, + where reached upwards, − where reached downwards"
    public = (Public("nm", "nm RMS, half the width of the loop", -1000.0, 1000.0),)
    sentence = "a focus stage hysteresis of {nm:+.0f} nm"
    separated_by = "every offset reached from both sides"
    look_alike = "a drift of focus; every offset from both sides distinguishes them"
    reference = "Saw-tooth of the first target in the on-sky experiment of LIFT for IRLOS"
    parameters = (Parameter("nm", "nm", 0.0, plausible=(-150.0, 150.0)),)

    def apply(self, values: Tensor, introduced_nm: Tensor, commanded_nm: np.ndarray) -> Tensor:
        return introduced_nm + values[0] * torch.as_tensor(travel_direction(commanded_nm))

    @classmethod
    def on_whole_ramp(cls, *, turns: bool) -> list[RampEffect]:
        """See `RampEffect.on_whole_ramp`: a ramp in one direction does not show it."""
        return [cls()] if turns else []


class FocusStageOffset(RampEffect):
    """A constant bias of the ramp, or of its frames with offsets in a range: two runs, two references.

    Parameters: `above_nm`, `below_nm`; the bias concerns commanded offsets between them.
    """

    name = "focus_stage_offset"
    formula = "introduced = commanded + nm, where above_nm < commanded < below_nm"
    repeatable = True  # of different parts of a ramp
    public = (Public("nm", "nm RMS", -2000.0, 2000.0),)
    options = (Public("above_nm", "nm RMS"), Public("below_nm", "nm RMS"))
    sentence = "a focus stage offset of {nm:+.0f} nm"
    separated_by = "the same offsets in another order, and a calibration at one of them"
    look_alike = "defocus among the NCPAs, exactly, unless it concerns a part of the ramp"
    reference = "Constant bias of the second target in the on-sky experiment of LIFT for IRLOS"
    parameters = (Parameter("nm", "nm", 0.0, plausible=(-300.0, 300.0)),)

    def __init__(self, above_nm: float = -np.inf, below_nm: float = np.inf):
        self.above_nm, self.below_nm = above_nm, below_nm

    @classmethod
    def on_parts(cls, offsets_nm: np.ndarray) -> list[RampEffect]:
        """See `RampEffect.on_parts`: on either side of an edge between two offsets."""
        edges = (offsets_nm[1:] + offsets_nm[:-1]) / 2 if len(offsets_nm) > 3 else []
        return [
            *(cls(above_nm=float(edge)) for edge in edges),
            *(cls(below_nm=float(edge)) for edge in edges),
        ]

    @property
    def part(self) -> dict[str, float]:
        limits = {"above_nm": float(self.above_nm), "below_nm": float(self.below_nm)}
        return {name: limit for name, limit in limits.items() if np.isfinite(limit)}

    def apply(self, values: Tensor, introduced_nm: Tensor, commanded_nm: np.ndarray) -> Tensor:
        concerned = (commanded_nm > self.above_nm) & (commanded_nm < self.below_nm)
        return introduced_nm + values[0] * torch.as_tensor(concerned.astype(float))


class FocusStageScale(RampEffect):
    """The stage moves by more than it is commanded, by a fraction.

    Its calibration is off, or the optics behind it turn the same step into more defocus; the estimates
    then lie on a straight line of another slope than one.
    """

    name = "focus_stage_scale"
    formula = "introduced = commanded · (1 + fraction)"
    public = (Public("fraction", "more than commanded", -0.9, 10.0),)
    sentence = "a focus stage scale of {fraction:+.1%}"
    separated_by = "larger offsets on both sides; a known lens"
    look_alike = "wrong wavelength or pixel scale, which scale all modes alike"
    reference = "Straight line through a ramp's estimates"
    parameters = (Parameter("fraction", "", 0.0, plausible=(-0.4, 0.4)),)

    def apply(self, values: Tensor, introduced_nm: Tensor, commanded_nm: np.ndarray) -> Tensor:
        return introduced_nm + values[0] * torch.as_tensor(np.asarray(commanded_nm, float))


class HighAperture(LensEffect):
    """Defocus is a sphere and not a parabola, because the focus moves where the beam is steep.

    Noll 4 then comes with Noll 11, 22 and further ones in fixed proportion. A single image cannot tell them
    from static spherical aberration, a ramp of focus can: they change with it. An estimate with the parabola
    finds another slope than one and its images do not fit far from focus.

    Parameters: `numerical_aperture`, NA / n of the beam in which the focus moves.
    """

    name = "high_aperture"
    formula = (
        "shape of defocus: √(1 − sine² ρ²) in place of ρ², ρ: radius over that of the pupil; same Noll 4"
    )
    public = (Public("sine", "NA / n where the focus moves", 0.0, HIGHEST_SINE),)
    sentence = "a focus moved in a beam of NA / n = {sine:.2f}"
    look_alike = "focus_stage_scale in the estimates of a ramp; its images far from focus distinguish them"
    reference = "Hopkins 1945, Proc. Phys. Soc. 55, 116"

    def __init__(self, numerical_aperture: float = 0.0):
        self.parameters = (Parameter("sine", "", numerical_aperture, lower=0.0, upper=HIGHEST_SINE),)

    @classmethod
    def under(cls, conditions: Conditions) -> "HighAperture":
        """See `Effect.under`: where the profile knows the aperture and it is high."""
        if not conditions.numerical_aperture > LEAST_SINE:
            raise ValueError("the profile knows no high numerical aperture of the beam in which focus moves")
        return cls(conditions.numerical_aperture)

    def apply(self, values: Tensor, settings: PsfSettings) -> PsfSettings:
        return replace(settings, focus_sine=float(values[0]))
