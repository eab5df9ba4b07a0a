"""What can be chosen of a calibration: method, loss, optimiser, modes, prior.

Five of the methods are those of the paper (its Fig. "methods"), the first puts the AO residual into the
model and needs the mean image only. `methods` fits them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.estimate.ncpa_prior import NcpaPrior
from irlos_pipe.numerics.loss import LOSSES, Loss, LossName

Fits = Literal["mean image", "every frame", "all frames"]
MethodName = Literal["long_exposure", "dip_global", "dip_avg", "dip_joint", "lift_avg", "lift_slices"]
DEFAULT_METHOD: MethodName = "long_exposure"
OptimiserName = Literal["lm", "lbfgs"]
OPEN: Final = "open"
HighestNoll = int | Literal["open"]


@dataclass(frozen=True)
class Method:
    name: str
    fits: Fits  # to which images, see `methods.SCHEMES`
    loss: LossName  # the default
    highest_noll: int  # default number of modes, Noll 2 to this
    open: bool  # whether they are only the first, and all that the window shows follow, see `open_fit`
    effects: bool  # whether the AO residual and jitter belong to the model
    description: str


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            "long_exposure",
            "mean image",
            "gaussian",
            66,
            True,
            True,
            "mean image; the AO residual's long-exposure OTF and the jitter are part of the model",
        ),
        Method(
            "dip_global",
            "every frame",
            "l1",
            30,
            False,
            False,
            "every frame by itself, coefficients averaged (paper, method 3)",
        ),
        Method("dip_avg", "mean image", "l1", 30, False, False, "mean image, L1 loss (paper, method 1)"),
        Method(
            "dip_joint",
            "all frames",
            "l1",
            30,
            False,
            False,
            "one coefficient vector for all frames (paper, method 2)",
        ),
        Method(
            "lift_avg",
            "mean image",
            "gaussian",
            30,
            False,
            False,
            "mean image, noise-weighted Gauss-Newton (paper, LIFT avg.)",
        ),
        Method(
            "lift_slices",
            "every frame",
            "gaussian",
            30,
            False,
            False,
            "every frame by itself, noise-weighted Gauss-Newton (paper, LIFT slices)",
        ),
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
    # by which the sign of the even modes is judged, see `twin`; None: by the data alone
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
