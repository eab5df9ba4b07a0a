"""The problems that LIFT presents to the solver: photon noise, and realisations of a few frames.

Images that are noise realisations of a few frames are very similar. Their derivatives are computed once
per frame and serve as curvature for all its realisations, whose gradients are exact and cost a fifth of
a Jacobian; what the curvature lacks the solver learns. On the way a coarse model will do, with what it lacks
near the frame to first order: it leaves some hundredths of a standard error to the exact one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import FRAMES_PER_GRADIENT, ImageFit, Layout
from irlos_pipe.frames.noise import NoiseModel


@dataclass(frozen=True)
class Alike:
    """Which frame every image is a realisation of."""

    # (frames, modes + 2, pixels), derivatives of the frames' images at unit flux with respect to modes, flux
    # and background
    columns: torch.Tensor
    frame: torch.Tensor  # (images,)
    reference_nm: torch.Tensor  # (frames, modes), where `columns` were taken
    coarse: ImageModel
    lacking: torch.Tensor  # (frames, modes + 2, pixels), what they have more than those of the `coarse` model

    def of(self, which: torch.Tensor) -> Alike:
        return replace(self, frame=self.frame[which])


def alike(model: ImageModel, reference_nm: torch.Tensor, frame: torch.Tensor) -> Alike | None:
    """Derivatives at wavefronts near those of the images; None where single fits are quick, or the only way.

    The wavefronts `reference_nm` (frames, modes) are those of frames, and `frame` (images,) says of which one
    each image is a realisation.
    """
    if model.general is not model or not model.can_pull_back:
        return None
    one, coarse = torch.ones(len(reference_nm), dtype=torch.float64), model.coarse()
    exact, rough = (
        each.predict_and_jacobian(reference_nm, one, torch.zeros_like(one), held=True)[1].flatten(2)
        for each in (model, coarse)
    )
    return Alike(exact, frame, reference_nm, coarse, exact - rough)


class AlikeFit(ImageFit):
    """`ImageFit` with the curvature of other images; single images, least squares, no free effects."""

    per_member = (*ImageFit.per_member, "_hessian")

    def __init__(self, *arguments, alike: Alike):
        super().__init__(*arguments)
        self._alike = alike
        every = torch.arange(len(self.images))
        self._hessian = self._map(self._curvature, self.prior_mean, every, FRAMES_PER_GRADIENT)[0]

    @property
    def quicker(self) -> Self:
        quick = self._alike.coarse
        return self if self.model is quick else self._with(model=quick)

    def members(self, which: torch.Tensor) -> Self:
        return super().members(which)._with(_alike=self._alike.of(which))

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        """See `Problem.normal_equations`; the gradient is exact, the Hessian approximate."""
        value, gradient = self.gradient(x, which)
        scale = torch.ones_like(x)
        scale[:, self.layout.modes] = x[:, -2, None]
        hessian = self._hessian[which] * scale[:, :, None] * scale[:, None, :]
        return value, gradient, hessian + torch.diag_embed(self.prior_precision[which])

    def predict_all(self, x: torch.Tensor) -> torch.Tensor:
        """See `ImageFit.predict_all`: in the precision of gradients, by the coarse model."""
        model_e = self.quicker._map(self.quicker._predicted, x, torch.arange(len(x)), FRAMES_PER_GRADIENT)[0]
        return model_e.double()

    def _predicted(self, x, which):
        return (self._image_and_pullback(x, which)[0].flatten(1).cpu(),)

    def _image_and_pullback(self, x, which):
        """See `ImageFit`; the coarse model gets what it lacks near the frame."""
        image, pullback = super()._image_and_pullback(x, which)
        alike, modes = self._alike, self.layout.modes
        if self.model is not alike.coarse:
            return image, pullback
        frame, flux = alike.frame[which], x[:, -2, None].to(image)
        slopes = alike.lacking[frame[0] if bool((frame == frame[0]).all()) else frame]
        ahead = torch.ones_like(x).to(image)
        ahead[:, modes], ahead[:, -1] = x[:, modes] - alike.reference_nm[frame], 0
        lacking = (ahead[:, None] @ slopes)[:, 0]

        def to_parameters(factors: torch.Tensor) -> torch.Tensor:
            found, pixels = pullback(factors), factors.flatten(1).to(slopes)
            found[:, modes] += flux * (pixels[:, None] @ slopes.mT)[:, 0, modes]
            found[:, -2] += (lacking * pixels).sum(1, dtype=torch.float64)
            return found

        return image + (flux * lacking).view_as(image), to_parameters

    def _curvature(self, _, which: torch.Tensor) -> tuple[torch.Tensor]:
        """That of images of unit flux, with the weights of each."""
        columns = self._alike.columns[self._alike.frame[which]] * self.root_weight[which.to(self.device)]
        return ((columns @ columns.mT).double().cpu(),)


class PhotonFit(ImageFit):
    """`ImageFit` of single images by their quasi-likelihood, see `NoiseModel`.

    Its slopes are those of least squares with the variances of the model as it is: the minimum is where
    endless re-weighting would end, but the objective is smooth and falls with every step. Images are (batch,
    1, pixels), `good` is (pixels,).
    """

    per_member = (*ImageFit.per_member, "_least")

    def __init__(
        self,
        model: ImageModel,
        layout: Layout,
        images_e: torch.Tensor,
        good: torch.Tensor,
        noise: NoiseModel,
    ):
        here = good.to(images_e.device)
        super().__init__(model, layout, images_e, torch.where(here, 1.0, torch.inf)[None, None])
        self._noise, self._good = noise, here.double()
        self._least = self._sum(images_e, images_e)

    def _sum(self, images_e: torch.Tensor, model_e: torch.Tensor) -> torch.Tensor:
        """Minus the quasi-likelihood of images (b, 1, pixels), (b,), float64."""
        pixels = self._noise.minus_quasi_likelihood(images_e.double(), model_e.double())
        return (pixels @ self._good)[:, 0]

    def _whitened(self, model_e: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        data = self.images[which.to(self.images.device)]
        model_e = model_e[:, None].to(data.dtype)
        root = self._noise.variance_e2(model_e).rsqrt() * self._good.to(data.dtype)
        return (data - model_e) * root, root

    def _value(self, residual: torch.Tensor, model_e: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        which = which.to(self.images.device)
        return (self._sum(self.images[which], model_e[:, None]) - self._least[which]).cpu()
