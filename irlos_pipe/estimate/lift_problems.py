"""The problems that LIFT presents to the solver: photon noise, and images near a known wavefront.

Noise realisations of a frame are near its wavefront. On the way to their own a coarse model will
do, with what it lacks near the frame to first order: it leaves some hundredths of a standard error to
the exact model, whose gradients take a step or two with the curvature of the other.
"""

from __future__ import annotations

import torch

from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.problem import CheapGradientProblem
from irlos_pipe.optics.psf import PsfModel

REACH_NM = 500.0  # from the known wavefront, in every mode: fits that go further get lost in noise


class NearModel(ImageModel):
    """A coarse model with what it lacks of an `exact` one near a wavefront (modes,), to first order."""

    def __init__(self, exact: ImageModel, near_nm: torch.Tensor):
        assert isinstance(exact.psf, PsfModel)
        psf, optics = exact.psf.coarse(exact.optics)
        rough, one = ImageModel(psf, exact.effects), torch.ones(1, dtype=torch.float64)
        super().__init__(psf, exact.effects)
        self._near_nm, self._last = near_nm, (NOTHING, optics)
        rough._last = self._last
        there = [
            model.predict_and_jacobian(near_nm[None], one, 0 * one, held=True) for model in (exact, rough)
        ]
        (image, columns), (rough_image, rough_columns) = there
        self._slopes = (columns - rough_columns)[0, :-2]
        self._image = (image - rough_image)[0].to(columns)

    @property
    def limits_nm(self) -> torch.Tensor:
        return torch.stack([self._near_nm - REACH_NM, self._near_nm + REACH_NM])

    def _unit(self, modes_nm, *arguments):
        return super()._unit(modes_nm, *arguments) + self._lacking(modes_nm)

    def _unit_and_jacobian(self, modes_nm, *arguments):
        unit, jacobian = super()._unit_and_jacobian(modes_nm, *arguments)
        return unit + self._lacking(modes_nm), jacobian + self._slopes

    def _unit_and_pullback(self, modes_nm):
        unit, to_modes = super()._unit_and_pullback(modes_nm)
        slopes = self._slopes.flatten(1).mT

        def pullback(factors: torch.Tensor) -> torch.Tensor:
            return to_modes(factors) + factors.flatten(1).to(slopes) @ slopes

        return unit + self._lacking(modes_nm), pullback

    def _lacking(self, modes_nm: torch.Tensor) -> torch.Tensor:
        ahead = (modes_nm - self._near_nm).to(self._slopes)
        return self._image + torch.tensordot(ahead, self._slopes, 1)


def near(model: ImageModel, near_nm: torch.Tensor) -> NearModel | None:
    """A quicker `model` near a wavefront (modes,); None where there is none."""
    psf = model.psf
    if not (isinstance(psf, PsfModel) and model.can_pull_back):
        return None
    return NearModel(model, near_nm) if len(psf.weights) > 2 or model.optics.by_mode else None


class NearFit(ImageFit, CheapGradientProblem):
    """A fit of single images, with a `NearModel`, of which those that leave its limits are given up."""

    confined, cheap_gradient = True, ImageFit.gradient


class NearlySolved(ImageFit):
    """The fit of a `model` by exact gradients, with limits and Hessians of another that is `nearly` it."""

    confined = True

    def __init__(self, nearly: ImageFit, model: ImageModel):
        super().__init__(model, nearly.layout, nearly.images, nearly.root_weight.double() ** -2)
        self._nearly, self.lower, self.upper = nearly, nearly.lower, nearly.upper

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        return *self.gradient(x, which), self._nearly.normal_equations(x, which)[2]


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
