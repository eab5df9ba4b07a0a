"""Fit of images whose variances follow the model, as a problem for the batched solver."""

from __future__ import annotations

import torch

from ..image_model import ImageModel
from ..noise import NoiseModel
from .image_fit import ImageFit
from .parameters import Layout


class PhotonFit(ImageFit):
    """`ImageFit` of single images by their quasi-likelihood, see `NoiseModel.half_deviance`.

    Its slopes are those of least squares with the variances of the model as it is: the minimum is where
    endless re-weighting would end, but the objective is smooth and falls with every step.

    Parameters
    ----------
    images_e : tensor, (batch, 1, pixels)
    pixel_mask : tensor of bool, (pixels,)
    noise : NoiseModel
    """

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
        self._noise = noise

    def _whitened(self, model_e: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        residual, mask = super()._whitened(model_e, which)
        root = mask * self._noise.variance_e2(model_e[:, None]) ** -0.5
        return residual * root, root

    def _value(self, residual: torch.Tensor, model_e: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        which = which.to(self.images.device)
        images_e = self.images[which].double()
        pixels = self._noise.half_deviance(images_e, model_e[:, None])
        return (pixels * (self.root_weight[which] > 0)).sum((1, 2)).cpu()
