"""What can be chosen of a calibration, and of LIFT; and parts of estimates.

Five of the methods are those of the paper (its Fig. "methods"), the first puts the AO residual into the
model and needs the mean image only. `methods` fits them. The parts are in results.json as they are:
every key is a field, described here only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import Final, Literal

from irlos_pipe.conventions.keys import DITTO, Number
from irlos_pipe.conventions.keys import key as item
from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.numerics.loss import LOSSES, Loss, LossName

Fits = Literal["mean image", "every frame", "all frames"]
MethodName = Literal["long_exposure", "dip_global", "dip_avg", "dip_joint", "lift_avg", "lift_slices"]
DEFAULT_METHOD: MethodName = "long_exposure"
OptimiserName = Literal["lm", "lbfgs"]
OPEN: Final = "open"
HighestNoll = int | Literal["open"]


POINTING_NM = 5000.0  # tip and tilt: where the star lies in the window says nothing about the optics
FOCUS_NM = 400.0  # an uncontrolled focus bias is common


@dataclass(frozen=True)
class NcpaPrior:
    """Gaussian prior of the modes about zero: the instrument's law of NCPAs, widened."""

    law: NcpaLaw
    scale: float  # factor on the law; above 1 the prior only steadies what the data do not determine

    def sigma_nm(self, nolls: Sequence[int]) -> torch.Tensor:
        """Standard deviation of every mode, (modes,) [nm RMS]; tip, tilt and focus are left almost free."""
        sigma = torch.as_tensor(self.scale * self.law.sigma_nm(nolls))
        noll = torch.as_tensor(list(nolls))
        sigma[noll < 4] = POINTING_NM
        sigma[noll == 4] = FOCUS_NM
        return sigma


@dataclass(frozen=True)
class Method:
    name: str
    fits: Fits  # to which images, see `methods.SCHEMES`
    loss: LossName  # the default
    highest_noll: int = HIGHEST_REPORTED_NOLL  # default number of modes, Noll 2 to this
    open: bool = False  # whether all that the window shows follow them, see `open_fit`
    effects: bool = False  # whether the AO residual and jitter belong to the model


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("long_exposure", "mean image", "gaussian", 66, open=True, effects=True),
        Method("dip_global", "every frame", "l1"),  # the paper's method 3
        Method("dip_avg", "mean image", "l1"),  # method 1
        Method("dip_joint", "all frames", "l1"),  # method 2
        Method("lift_avg", "mean image", "gaussian"),  # its LIFT avg.
        Method("lift_slices", "every frame", "gaussian"),  # and LIFT slices
    )
}


@dataclass(frozen=True)
class CalibrationOptions:
    """Choices of the user; None takes the method's default."""

    method: str = DEFAULT_METHOD  # a key of `METHODS`
    loss: LossName | None = None
    optimiser: OptimiserName = "lm"
    # modes Noll 2 to this are estimated, or with "open" as many as the window shows
    highest_noll: HighestNoll | None = None
    prior: NcpaPrior | None = None
    max_iterations: int = 100
    # by which the sign of the even modes is judged, see `check_twin`; None: by the data alone
    law: NcpaLaw | None = None

    @property
    def last_noll(self) -> int:
        """Modes Noll 2 to this are estimated, of an open basis first; the method's own choice filled in."""
        given = self.highest_noll
        return given if isinstance(given, int) else METHODS[self.method].highest_noll

    @property
    def open(self) -> bool:
        """Whether all modes that the window shows follow."""
        return METHODS[self.method].open and not isinstance(self.highest_noll, int)

    @property
    def loss_function(self) -> Loss:
        """The loss, the method's own choice filled in."""
        return LOSSES[self.loss or METHODS[self.method].loss]

    def resolved(self) -> CalibrationOptions:
        """Return the same with the method's defaults filled in."""
        highest_noll: HighestNoll = OPEN if self.open else self.last_noll
        return replace(self, loss=self.loss_function.name, highest_noll=highest_noll)


NoiseSource = Literal["data", "model", "iterative"]


@dataclass(frozen=True)
class LiftOptions:
    """The same of LIFT."""

    # where the variances come from: the smoothed image ("data"); the model fitted with those ("model"); or
    # the model of the very estimate ("iterative")
    noise: NoiseSource = "iterative"
    # (images, modes), and (modes,): Gaussian prior; with it the estimate is MAP, without it ML
    prior_mean_nm: torch.Tensor | None = None
    prior_sigma_nm: torch.Tensor | None = None
    max_iterations: int = 40
    # Of the residuals: whitened, but in electrons for "l1", the loss of the paper's DIP. Variances cannot
    # follow the very estimate of a robust loss: with "iterative" they are those of "model".
    loss: LossName = "gaussian"

    @property
    def loss_function(self) -> Loss:
        return LOSSES[self.loss]

    def of(self, which: torch.Tensor) -> LiftOptions:
        mean_nm = self.prior_mean_nm
        return replace(self, prior_mean_nm=mean_nm if mean_nm is None else mean_nm[which])


DECISIVE = 10.0  # evidence from which a sign counts as known: odds of 150 to 1


@dataclass(frozen=True)
class TwinCheck:
    """Comparison with the twin solution, see `estimate.starts`."""

    delta_chi2: Number = item(nan, "χ² of the refitted twin minus that of the solution, prior included.")
    rms_nm: Number = item(
        nan, "RMS of the coefficients of the solution and of the twin, without tip and tilt."
    )
    twin_rms_nm: Number = item(nan, DITTO)
    distance_nm: Number = item(
        nan, "RMS difference between the two; near 0 where the twin fell back into the solution."
    )
    # The prior of the fit is wider than the law, so that it does not bend the estimates; it would understate
    # what the law says of a twin, which needs twice the diversity as an aberration.
    evidence: Number = item(
        nan,
        "-2 times the logarithm of the odds of the twin, by the data and the law of NCPAs; large: excluded.",
    )
    preferred: str = item("", "``solution``, ``twin``, or ``undecided`` where neither data nor law tell.")

    def __post_init__(self) -> None:
        preferred = "twin" if self.evidence < -DECISIVE else "undecided"
        if self.distance_nm < 1.0 or self.evidence > DECISIVE:
            preferred = "solution"
        object.__setattr__(self, "preferred", preferred)


@dataclass(frozen=True)
class Cause:
    """A fact or effect that would explain why a check failed, see `estimate.causes`."""

    name: str = item("", "What it is: a short identifier, such as ``plate_scale`` or ``transposed``.")
    says: str = item("", "The whole sentence for a person, key included.")
    explains: Number = item(nan, "Part of the misfit that it explains, 0 to 1; NaN where it is no misfit.")
    value: Number = item(
        nan,
        "Value that the data want, its standard error and the declared value; NaN where none is a number.",
    )
    sigma: Number = item(nan, DITTO)
    declared: Number = item(nan, DITTO)
    unit: str = item("", "Unit of the three.")
    key: str = item("", "Key of the side-car or profile to change; empty where none is.")
    figure: str = item("", "Figure of the report to look at, by its name there, such as ``cal-residual``.")


@dataclass(frozen=True)
class StrehlPart:
    """What one part of the model does to the Strehl ratio, see `estimate.correction.strehl_budget`."""

    name: str = item("", "Part of the model: all of it, its modes, or an effect.")
    wfe_nm: Number = item(nan, "RMS of its modes; NaN of an effect.")
    alone: Number = item(nan, "Strehl ratio with nothing else in the model, and with all else but this part.")
    without: Number = item(nan, DITTO)


@dataclass(frozen=True)
class OneSetup:
    """One of several set-ups, such as planes of known defocus, that were fitted together."""

    name: str = item("", "Its recordings.")
    introduced_nm: Number = item(nan, "Noll 4 of what is known of its wavefront.")
    frames: int = item(0, "Used frames.")
    chi2_nu: Number = item(nan, "Reduced χ² of its mean image.")
    focus_nm: Number = item(
        nan,
        "Defocus beyond the known and the common one that its image by itself wants, and the standard error.",
    )
    focus_sigma_nm: Number = item(nan, DITTO)
