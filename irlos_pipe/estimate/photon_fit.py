"""Fit of images whose variances follow the model, as a problem for the batched solver."""

from __future__ import annotations

import torch

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.estimate.parameters import Layout
from irlos_pipe.frames.noise import NoiseModel


class PhotonFit(ImageFit):
    """`ImageFit` of single images by their quasi-likelihood, see `NoiseModel`.

    Its slopes are those of least squares with the variances of the model as it is: the minimum is where
    endless re-weighting would end, but the objective is smooth and falls with every step.

    Parameters
    ----------
    images_e : tensor, (batch, 1, pixels)
    pixel_mask : tensor of bool, (pixels,)
    noise : NoiseModel
    """

    per_member = (*ImageFit.per_member, "_least")

    def __init__(
        self,
        model: ImageModel,
        layout: Layout,
        images_e: torch.Tensor,
        pixel_mask: torch.Tensor,
        noise: NoiseModel,
    ):
        mask = pixel_mask.to(images_e.device)
        super().__init__(model, layout, images_e, torch.where(mask, 1.0, torch.inf)[None, None])
        self._noise, self._mask = noise, mask.double()
        self._least = self._sum(images_e, images_e)

    def _sum(self, images_e: torch.Tensor, model_e: torch.Tensor) -> torch.Tensor:
        """Minus the quasi-likelihood of images (b, 1, pixels), (b,), float64."""
        pixels = self._noise.minus_quasi_likelihood(images_e.double(), model_e.double())
        return (pixels @ self._mask)[:, 0]

    def _whitened(self, model_e: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        data = self.images[which.to(self.images.device)]
        model_e = model_e[:, None].to(data.dtype)
        root = self._noise.variance_e2(model_e).rsqrt() * self._mask.to(data.dtype)
        return (data - model_e) * root, root

    def _value(self, residual: torch.Tensor, model_e: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        which = which.to(self.images.device)
        return (self._sum(self.images[which], model_e[:, None]) - self._least[which]).cpu()
