"""Least-squares fits of many images that are much alike: noise realisations of a few frames.

Derivatives of the image are computed once per frame. They serve as curvature for all its realisations, whose
gradients are exact and cost a fifth of a Jacobian; what the curvature lacks the solver learns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import FRAMES_PER_CHUNK, FRAMES_PER_GRADIENT, ImageFit

LEAST_FRAMES = 4  # in a piece


@dataclass(frozen=True)
class Alike:
    """Which frame every image is a realisation of.

    Attributes
    ----------
    columns : tensor, (frames, modes + 2, pixels)
        Derivatives of the frames' images at unit flux with respect to modes, flux and background.
    frame : tensor of int, (images,)
    """

    columns: torch.Tensor
    frame: torch.Tensor

    def of(self, which: torch.Tensor) -> Alike:
        """The same for some of the images."""
        return replace(self, frame=self.frame[which])


def alike(model: ImageModel, reference_nm: torch.Tensor, frame: torch.Tensor) -> Alike | None:
    """Derivatives at wavefronts near those of the images; None where single fits are quick, or the only way.

    Parameters
    ----------
    model : ImageModel
    reference_nm : tensor, (frames, modes)
    frame : tensor of int, (images,)
    """
    if model.general is not model or not model.can_pull_back:
        return None
    one = torch.ones(len(reference_nm), dtype=torch.float64)
    columns = model.predict_and_jacobian(reference_nm, one, torch.zeros_like(one), held=True)[1]
    return Alike(columns.flatten(2), frame)


class AlikeFit(ImageFit):
    """`ImageFit` with the curvature of other images; single images, least squares, no free effects.

    Parameters
    ----------
    alike : Alike
    """

    def __init__(self, *arguments, alike: Alike):
        super().__init__(*arguments)
        self._alike = alike

    def members(self, which: torch.Tensor) -> AlikeFit:
        """See `ImageFit.members`."""
        return super().members(which)._with(_alike=self._alike.of(which))

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        """Objective, exact gradient and approximate Hessian, see `solve.Problem`."""
        value, gradient = self.gradient(x, which)
        (hessian,) = self._map(self._curvature, x, which, FRAMES_PER_GRADIENT)
        return value, gradient, hessian + torch.diag_embed(self.prior_precision[which])

    def _map(self, function, x, which, size: int = FRAMES_PER_CHUNK):
        """As in `ImageFit`, but two pieces of what is left when most members are done, lest workers idle."""
        return super()._map(function, x, which, min(size, max(LEAST_FRAMES, -(-len(x) // 2))))

    def _curvature(self, x: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor]:
        columns = self._alike.columns[self._alike.frame[which]] * self.root_weight[which.to(self.device)]
        hessian = (columns @ columns.mT).double().cpu()
        scale = torch.ones_like(x)
        scale[:, self.layout.modes] = x[:, -2, None]
        return (hessian * scale[:, :, None] * scale[:, None, :],)
