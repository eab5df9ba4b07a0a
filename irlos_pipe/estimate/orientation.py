"""Whether images are mirrored: what they say of vanes and of all else that a mirrored pupil has elsewhere.

A mirrored image is the image of a mirrored wavefront through a mirrored pupil. Modes follow any wavefront, so
only the pupil tells. About the fit with the pupil as told, the mean image is

    I = I_fit + a (I_mirrored − I_fit) + what the parameters follow,

where I_mirrored has the same wavefront behind the mirrored pupil: a is 0 for the pupil as told, and 1 for the
mirrored one. It is estimated by weighted least squares, without what the fitted parameters would follow; its
error is the scatter of the same estimate over the frames, their autocorrelation included.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.pupil_drawing import placed
from irlos_pipe.conventions.pupil_parts import Placement
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.cube import Frames, autocorrelation_time, mean_variance_e2
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.frames.blocks import sample_frames
from irlos_pipe.optics.lenslets import light_path

LEAST_FRAMES = 4
SIGNIFICANT = 4.0  # standard errors
LARGEST_SIGMA = 0.25
LEAST_EFFECT = 1e-100  # of a parameter on the image, instead of none
MIRROR = Placement(mirrored=True)


@dataclass(frozen=True)
class Mirrored:
    """Amplitude of the mirrored pupil, and its standard error."""

    amplitude: float
    sigma: float

    @property
    def tells(self) -> bool:
        """Whether the error is small enough to tell the mirrored pupil from that as told."""
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
    """Return how much of the mirrored pupil the mean image shows; None where nothing tells.

    Parameters
    ----------
    frames : Frames
    problem : ImageFit
        With which their mean was fitted.
    values : tensor, (1, parameters)
        Of the fit.
    """
    if len(frames.images_e) < LEAST_FRAMES:
        return None
    image, jacobian = problem.predict_and_jacobian(values)
    difference = _mirrored_problem(problem).predict(values)[0].cpu() - image[0].cpu()
    variance = mean_variance_e2(frames).flatten()
    root = torch.where(frames.good.flatten() & torch.isfinite(variance), variance**-0.5, 0.0)
    columns = (jacobian[0].double().cpu() * root).mT
    along = _not_followed(difference * root, columns, problem.prior_precision[0].double().cpu())
    length = float(along @ along)
    if not length > 0:
        return None
    some = frames.images_e[torch.as_tensor(sample_frames(len(frames.images_e)))].flatten(1).double()
    amplitudes = (torch.where(root > 0, (some - image[0].cpu()) * root, 0.0) @ along / length).numpy()
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


def _mirrored_problem(problem: ImageFit) -> ImageFit:
    """The same problem with the mirrored pupil."""
    psf = problem.model.psf
    settings = replace(psf.settings, geometry=placed(psf.settings.geometry, MIRROR))
    other = light_path(settings, psf.nolls, device=psf.device, dtype=torch.float64)
    return problem.with_model(ImageModel(other, problem.model.effects.effects))
