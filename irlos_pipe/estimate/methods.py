"""The ways to calibrate NCPAs from a cube: what is fitted to what, and with which loss.

The first five are those of the paper (its Fig. "methods"), the sixth puts the AO residual
into the model and needs the mean image only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Method:
    """A calibration method.

    Attributes
    ----------
    name : str
    images : {"mean", "frames", "joint"}
        Fit the mean image; every frame by itself and average the coefficients; or all
        frames with one coefficient vector.
    loss : str
        Default loss.
    highest_noll : int
        Default number of modes, Noll 2 to this.
    effects : bool
        Whether the AO residual and jitter belong to the model.
    """

    name: str
    images: Literal["mean", "frames", "joint"]
    loss: str
    highest_noll: int
    effects: bool
    description: str


METHODS = {
    method.name: method
    for method in (
        Method(
            "long_exposure",
            "mean",
            "gaussian",
            66,
            True,
            "mean image; the AO residual's long-exposure OTF and the jitter are part of the model",
        ),
        Method(
            "dip_global",
            "frames",
            "l1",
            30,
            False,
            "every frame by itself, coefficients averaged (paper, method 3)",
        ),
        Method("dip_avg", "mean", "l1", 30, False, "mean image, L1 loss (paper, method 1)"),
        Method(
            "dip_joint", "joint", "l1", 30, False, "one coefficient vector for all frames (paper, method 2)"
        ),
        Method(
            "lift_avg",
            "mean",
            "gaussian",
            30,
            False,
            "mean image, noise-weighted Gauss-Newton (paper, LIFT avg.)",
        ),
        Method(
            "lift_slices",
            "frames",
            "gaussian",
            30,
            False,
            "every frame by itself, noise-weighted Gauss-Newton (paper, LIFT slices)",
        ),
    )
}
