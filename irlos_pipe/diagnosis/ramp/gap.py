"""Which light path a ramp's images prefer, and the gap between held-out images and what its offsets predict.

The light path is decided before estimates are held against the focus stage. Two models with as many free
parameters each are fitted to the frames that a diagnosis may see; frames that it may not see decide between
them, each with its own tip, tilt, focus, flux and background.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.diagnosis.records import Gap
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.ramp_fit import RampData, RampFit

STEPS = 3  # Gauss–Newton steps of what belongs to single frames, which is nearly linear
FRAMES_AT_ONCE = 8  # bounds the memory of the derivatives


def ramp_gap(
    model: ImageModel,
    data: RampData,
    start_nm: torch.Tensor,
    before_nm: np.ndarray,
    after_nm: np.ndarray,
    held_out: np.ndarray,
) -> Gap:
    """``Σ|measured − predicted| / Σ measured`` of the mean images per offset of the held-out frames.

    Tip, tilt, flux and background of every frame are refitted. The defocus is `before_nm`, as commanded, and
    `after_nm`, as corrected, (frames,); other modes are estimates, `start_nm`, (frames, modes). The `model`
    has Noll 2, 3 and 4 among its modes and no free effects.
    """
    chosen = torch.as_tensor(held_out)
    images, offsets = data.images_e.double()[chosen], data.introduced_nm[held_out]
    good = data.good
    predicted = [
        _predicted(model, data, images, _with_defocus(model, start_nm, defocus)[chosen])
        for defocus in (before_nm, after_nm)
    ]
    groups = [torch.as_tensor(offsets == value) for value in np.unique(offsets)]
    total = sum(float(images[group].mean(0)[good].sum()) for group in groups)
    before, after = (
        sum(float((images[g].mean(0) - model_e[g].mean(0))[good].abs().sum()) for g in groups) / total
        for model_e in predicted
    )
    noise = [
        _noise_e(data, torch.as_tensor(data.introduced_nm == value), int((offsets == value).sum()))
        for value in np.unique(offsets)
    ]
    return Gap(before, after, sum(noise) / total)


def _with_defocus(model: ImageModel, start_nm: torch.Tensor, defocus_nm: np.ndarray) -> torch.Tensor:
    modes = start_nm.clone()
    modes[:, model.psf.nolls.index(4)] = torch.as_tensor(defocus_nm)
    return modes


def _predicted(
    model: ImageModel, data: RampData, images: torch.Tensor, modes_nm: torch.Tensor
) -> torch.Tensor:
    """Predictions of frames (frames, rows, columns) by few frames at a time."""
    parts = zip(images.split(FRAMES_AT_ONCE), modes_nm.split(FRAMES_AT_ONCE), strict=True)
    return torch.cat([_refitted(model, data, *part) for part in parts])


def _refitted(
    model: ImageModel, data: RampData, images: torch.Tensor, modes_nm: torch.Tensor
) -> torch.Tensor:
    """Gauss–Newton steps of tip, tilt, flux and background."""
    root = torch.where(data.good, data.noise.variance_e2(images) ** -0.5, 0.0).flatten(1)
    own = [model.psf.nolls.index(2), model.psf.nolls.index(3), -2, -1]
    modes, light = modes_nm.clone(), torch.stack([images.sum((1, 2)), torch.zeros(len(images))], dim=1)
    for _ in range(STEPS):
        found = model.predict_and_jacobian(modes, light[:, 0], light[:, 1], held=True)
        image, columns = (one.cpu() for one in found)
        design = columns[:, own].double().flatten(2).mT * root[:, :, None]
        misfit = (images.flatten(1) - image.flatten(1)) * root
        step = torch.linalg.lstsq(design, misfit[:, :, None]).solution[..., 0]
        modes[:, own[:2]] += step[:, :2]
        light = light + step[:, 2:]
    return model.predict(modes, light[:, 0], light[:, 1]).cpu()


def _noise_e(data: RampData, at_offset: torch.Tensor, averaged: int) -> float:
    """What noise leaves of a mean of `averaged` frames, from the scatter of all frames at the offset.

    A normal deviate is √(2/π) σ away from zero on average.
    """
    images = data.images_e.double()[at_offset]
    photons = data.noise.scatter_e2(images.mean(0))
    scatter = images.var(0, correction=1) if len(images) > 1 else photons
    sigma = (torch.maximum(photons, scatter) / averaged + data.noise.shared_e2).sqrt()
    return float(np.sqrt(2 / np.pi) * sigma[data.good].sum())


COMPLETE_CHI2_NU = 1.2  # of images that a model explains; simulated ones have 1.0 within 0.1


@dataclass(frozen=True)
class Comparison:
    """Two fits of a ramp on the frames held out."""

    # Mean of the frames, with the model as it was and with the candidate.
    chi2_nu: tuple[float, float]
    better: float  # part of the frames that the candidate fits better
    # Root of the fall of χ² per unit of the χ²/ν that the candidate leaves, which stands for the errors of
    # both models.
    significance: float
    gap: tuple[float, float]  # ``Σ|measured − predicted| / Σ measured``

    @property
    def complete(self) -> bool:
        """Return whether it leaves little but noise; else estimates of the focus share its errors."""
        return self.chi2_nu[1] < COMPLETE_CHI2_NU

    def favours(self, sure: float) -> bool:
        """Return whether the candidate is `sure` σ better, and so in most of the frames."""
        return self.significance > sure and self.better > 0.5


@dataclass(frozen=True)
class LightPathName:
    """An effect on the light path that the images prefer."""

    effect: Effect
    values: Sequence[float]
    comparison: Comparison

    @property
    def public(self) -> dict[str, float]:
        """Its size under public names."""
        return self.effect.describe(np.array(self.values))

    @property
    def phrase(self) -> str:
        """The effect with its size, as a sentence names it."""
        return self.effect.phrase(self.public)


def compare(data: RampData, plain: RampFit, candidate: RampFit, held_out: np.ndarray) -> Comparison:
    """Compare two fits of the ramp `data` on the frames `held_out`, (frames,) of bool."""
    which = torch.as_tensor(held_out)
    before, after = (fit.result.chi2_nu[which].double() for fit in (plain, candidate))
    good = torch.isfinite(before) & torch.isfinite(after)
    before, after = before[good], after[good]
    pixels = int(data.good.sum())
    fall = float((before - after).sum()) * pixels / max(float(after.mean()), 1.0)
    gaps = [_gap(data, fit, which) for fit in (plain, candidate)]
    return Comparison(
        (float(before.mean()), float(after.mean())),
        float((after < before).double().mean()),
        float(np.sign(fall) * np.sqrt(abs(fall))),
        (gaps[0], gaps[1]),
    )


def _gap(data: RampData, fit: RampFit, which: torch.Tensor) -> float:
    images = data.images_e[which].double()[:, data.good]
    model = fit.result.model_e[which].double().reshape(len(images), *data.good.shape)[:, data.good]
    return float((images - model).abs().sum() / images.sum())
