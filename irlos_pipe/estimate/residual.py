"""What the residual of a fit says: an uneven AO residual, a mirrored pupil, frames of two kinds.

`uneven` asks for an AO residual that is uneven over the pupil, which the modes imitate: whether the scores
``p = Lᵀ r`` of the residual r, with what the fitted parameters leave L of its shapes, are beyond their
covariance V, from their scatter over the frames: ``pᵀ V⁻¹ p`` against χ² of as many scores.

A mirrored image is the image of a mirrored wavefront through a mirrored pupil. Modes follow any wavefront, so
only the pupil shows it. About the fit with the pupil as declared, the mean image is

    I = I_fit + a (I_mirrored − I_fit) + what the parameters follow,

where I_mirrored has the same wavefront behind the mirrored pupil: a is 0 for the pupil as declared, and 1 for
the mirrored one. It is estimated by weighted least squares, without what the fitted parameters would follow;
its error is the scatter of the same estimate over the frames, their autocorrelation included.

Frames may be a mixture of two kinds: stars, pointings, wavefronts. A mixture scatters by more than its parts,
so that its scatter excuses what a single model misfits. But it does not scatter as noise does: along the
direction in which most of the variance lies, frames of two kinds sit at two values. Their kurtosis is 1 for
halves, 3 for Gaussian scatter and 1.5 for a sinusoidal vibration. Differences in brightness do not count.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.pupil_drawing import placed
from irlos_pipe.conventions.pupil_parts import Placement
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.seeing_halo import SeeingHalo, UnevenResidual
from irlos_pipe.estimate.cube import Frames, autocorrelation_time, covariance_of_mean, mean_variance_e2
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.estimate.score_test import derivatives, frozen_effects, null_model
from irlos_pipe.numerics.solver import Solution
from irlos_pipe.optics.lenslets import light_path

BEYOND_CHANCE = 5.0  # standard deviations by which scores exceed what their scatter makes


def uneven(frames: Frames, problem: ImageFit, solution: Solution) -> UnevenResidual | None:
    """Return the unevenness over the pupil of an AO residual where the images show one.

    The mean of the `frames` was fitted with `problem`. There is none where the model has it already or has no
    AO residual, nor where the frames' scatter explains what is seen of it.
    """
    x, effects = solution.values[:1], problem.model.effects
    halos = [
        base for base in (getattr(one, "base", one) for one in effects.effects) if type(base) is SeeingHalo
    ]
    if not halos or UnevenResidual.name in {one.name for one in effects.effects}:
        return None
    halo, null = halos[0], null_model(problem, x)
    found = UnevenResidual(halo.band, halo.law, halo.seeing_arcsec)
    frozen = frozen_effects(effects, x[0, problem.layout.effect_values])
    left = null.project(derivatives(problem, x, frozen, found).mT * null.root[:, None])
    images, mean, flux = frames.images_e.flatten(1), frames.mean_e.flatten(), frames.flux_e[:, None]
    deviations = torch.where(null.root > 0, (images * (flux.mean() / flux) - mean) * null.root, 0.0)
    inverse = torch.linalg.inv(torch.as_tensor(covariance_of_mean((deviations @ left).numpy())))
    score = left.mT @ null.residual
    by_chance = len(score) + BEYOND_CHANCE * np.sqrt(2 * len(score))
    return found if float(score @ inverse @ score) > by_chance else None


LEAST_FRAMES = 4
SIGNIFICANT = 4.0  # standard errors from which an amplitude counts
LARGEST_SIGMA = 0.25
LEAST_EFFECT = 1e-100  # effect of a parameter on the image, instead of none: avoids division by zero
MIRROR = Placement(mirrored=True)


@dataclass(frozen=True)
class Mirrored:
    """Amplitude of the mirrored pupil, and its standard error."""

    amplitude: float
    sigma: float

    @property
    def tells(self) -> bool:
        """Whether the error is small enough to distinguish the mirrored pupil from the declared one."""
        return self.sigma <= LARGEST_SIGMA

    @property
    def limit(self) -> float:
        """Amplitude above which the images are mirrored: nearer to 1, and no chance."""
        return max(0.5, SIGNIFICANT * self.sigma)

    @property
    def seen(self) -> bool:
        """Whether the images are mirrored."""
        return self.tells and self.amplitude > self.limit


def mirrored(frames: Frames, problem: ImageFit, values: torch.Tensor) -> Mirrored | None:
    """Return how much of the mirrored pupil the mean image shows; None where nothing determines it.

    The mean of the `frames` was fitted with `problem`, at `values` (1, parameters).
    """
    if len(frames.images_e) < LEAST_FRAMES:
        return None
    image, jacobian = problem.predict_and_jacobian(values)
    psf = problem.model.psf
    settings = replace(psf.settings, geometry=placed(psf.settings.geometry, MIRROR))
    path = light_path(settings, psf.nolls, device=psf.device, dtype=torch.float64)
    other = problem.with_model(ImageModel(path, problem.model.effects.effects))
    difference = other.predict(values)[0].cpu() - image[0].cpu()
    root = frames.root
    columns = (jacobian[0].double().cpu() * root).mT
    along = _not_followed(difference * root, columns, problem.prior_precision[0].double().cpu())
    length = float(along @ along)
    if not length > 0:
        return None
    deviations = torch.where(root > 0, (frames.sample_e - image[0].cpu()) * root, 0.0)
    amplitudes = (deviations @ along / length).numpy()
    whole = torch.where(root > 0, (frames.mean_e.flatten() - image[0].cpu()) * root, 0.0)
    independent = len(amplitudes) / float(autocorrelation_time(amplitudes[:, None])[0])
    return Mirrored(float(whole @ along / length), float(amplitudes.std(ddof=1) / np.sqrt(independent)))


def _not_followed(change: torch.Tensor, columns: torch.Tensor, precision: torch.Tensor) -> torch.Tensor:
    """What is left of a `change` of the image (pixels,) when the parameters have followed it.

    Some parameters may have no effect where the fit ended: the direction of a stop at no distance.
    """
    both = torch.cat([columns, torch.diag(precision.sqrt())])
    scale = both.norm(dim=0).clamp_min(LEAST_EFFECT)
    sought = torch.cat([change, torch.zeros(len(precision), dtype=torch.float64)])
    steps = torch.linalg.lstsq(both / scale, sought[:, None], driver="gelsd").solution[:, 0]
    return change - columns @ (steps / scale)


FRAMES_OF_A_KIND = 20  # Gaussian scatter of so many has a kurtosis below 1.3 in one of 100 000 cubes
FEWEST_OF_A_KIND = 6  # from so many two kinds in halves, which have 1, are no chance
CLEAR = 0.3  # by which it exceeds 1 where fewer than `FRAMES_OF_A_KIND` would tell, times their part squared
LEADING = 0.3  # part of the variance from which a single direction is examined


def kurtosis_of_frames(frames: Frames) -> float:
    """Return the kurtosis of the frames along the direction in which they differ most.

    NaN where no direction leads, and of fewer than `FRAMES_OF_A_KIND` unless they clearly are of two kinds:
    by chance Gaussian scatter is taken for that in one of 5000 cubes at most.
    """
    some = frames.sample_e
    if len(some) < FEWEST_OF_A_KIND:
        return float("nan")
    variance = mean_variance_e2(frames).flatten()
    usable = frames.good.flatten() & torch.isfinite(variance) & torch.isfinite(some).all(0)
    whitened = ((some - some.mean(0)) * variance**-0.5)[:, usable]
    star = (some.mean(0) * variance**-0.5)[usable]
    whitened -= (whitened @ star)[:, None] * (star / (star @ star))  # clouds dim the same star
    values, vectors = np.linalg.eigh((whitened @ whitened.mT).numpy())
    if not values[-1] > LEADING * values.sum():
        return float("nan")
    along = vectors[:, -1] - vectors[:, -1].mean()
    kurtosis = float(len(along) * np.sum(along**4) / np.sum(along**2) ** 2)
    clear = kurtosis < 1 + CLEAR * (len(some) / FRAMES_OF_A_KIND) ** 2
    return kurtosis if clear or len(some) >= FRAMES_OF_A_KIND else float("nan")
