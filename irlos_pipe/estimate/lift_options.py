"""What can be chosen of LIFT."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from irlos_pipe.conventions.late import torch

if TYPE_CHECKING:
    from irlos_pipe.estimate.lift_problems import Alike

NoiseSource = Literal["data", "model", "iterative"]


@dataclass(frozen=True)
class LiftOptions:
    """Choices of LIFT.

    Attributes
    ----------
    noise : {"data", "model", "iterative"}
        Where the variances come from: the smoothed image; the model fitted with those; or the
        model of the very estimate.
    prior_mean_nm, prior_sigma_nm : tensor, (images, modes) and (modes,), optional
        Gaussian prior; with it the estimate is MAP, without it ML.
    alike : Alike, optional
        Where many images are realisations of a few frames: quicker, covariances are those of the frames.
    """

    noise: NoiseSource = "iterative"
    prior_mean_nm: torch.Tensor | None = None
    prior_sigma_nm: torch.Tensor | None = None
    max_iterations: int = 40
    alike: Alike | None = None

    def of(self, which: torch.Tensor) -> LiftOptions:
        """Return the same for some of the images."""
        mean_nm, alike = self.prior_mean_nm, self.alike
        return replace(
            self,
            prior_mean_nm=mean_nm if mean_nm is None else mean_nm[which],
            alike=alike if alike is None else alike.of(which),
        )
