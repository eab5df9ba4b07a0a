"""What can be chosen of LIFT."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from irlos_pipe.conventions.late import torch
from irlos_pipe.numerics.loss import LOSSES, Loss, LossName

NoiseSource = Literal["data", "model", "iterative"]


@dataclass(frozen=True)
class LiftOptions:
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
