"""The ways to fit the images of a cube: their mean, every frame, or all frames together.

The frames of a cube are very similar: what their fits share is computed once. The curvature at a few frames
serves all others, and what it misses is learnt from the gradients along the way (`quasi_newton`). Plain least
squares come first, as their curvature hardly changes. Only frames that are not done then get a linearisation
of their own.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions, Fits
from irlos_pipe.estimate.cube import Frames, mean_variance_e2
from irlos_pipe.estimate.effect_modes import whole_wavefront
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.estimate.starts import median_of_frames_nm, start_tilts_nm
from irlos_pipe.estimate.twin import TwinCheck, check_twin
from irlos_pipe.frames.blocks import blocks
from irlos_pipe.numerics.levenberg_marquardt import scaled_inverse, solve
from irlos_pipe.numerics.loss import GAUSSIAN
from irlos_pipe.numerics.quasi_newton import polish
from irlos_pipe.numerics.solution import CONVERGED, INVALID, MAX_ITERATIONS, Solution
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.optics.psf_settings import PsfSettings

ROUGH_ITERATIONS = 6  # iterations of the few frames whose median is the start of all others
Report = Callable[[int], None]


@dataclass(frozen=True)
class Estimates:
    """Estimates of the modes from a fit."""

    values: torch.Tensor  # (1, parameters), of all frames together
    zernike_nm: np.ndarray  # (modes,), the whole static wavefront
    frames_nm: np.ndarray  # (frames, modes), the same of every frame; NaN where its fit failed


class Scheme(ABC):
    """Which images of a cube are fitted, and how many coefficient vectors there are."""

    @abstractmethod
    def data(self, frames: Frames) -> tuple[torch.Tensor, torch.Tensor]:
        """Images (batch, repeats, rows, columns) [e-], and their variance, which broadcasts to them."""

    def fits(self, frames: Frames) -> int:
        """Return the number of fits."""
        return 1

    def psf_model(self, settings: PsfSettings, nolls: Sequence[int], device: str) -> LightPath:
        """PSF model for `settings` with the modes `nolls` on a `device`, as precise as the images need."""
        return light_path(settings.for_single_frames(), nolls, device=device)

    def start(self, frames: Frames, problem: ImageFit) -> torch.Tensor:
        """Return the start of the `problem` of these `frames` when nothing is known, (batch, parameters)."""
        return start_at_centroids(frames, problem)

    def solve(
        self, problem: ImageFit, start: torch.Tensor, max_iterations: int, report: Report | None
    ) -> Solution:
        """Minimise the `problem` from a `start` in `max_iterations`; see `solve` for `report`."""
        return solve(problem, start, max_iterations=max_iterations, report=report)

    def estimates(self, frames: Frames, problem: ImageFit, solution: Solution) -> Estimates:
        """Return the modes from the `solution` of the `problem` of these `frames`."""
        return linear_estimates(frames, problem, solution)

    def twin(self, problem: ImageFit, solution: Solution, law: NcpaLaw | None) -> TwinCheck | None:
        """Compare the `solution` of a `problem` with its twin under a `law`, where that is of use."""
        return None


class MeanImage(Scheme):
    """The mean image by one vector; it is so precise that rounding of float32 would stall its fit."""

    def data(self, frames: Frames) -> tuple[torch.Tensor, torch.Tensor]:
        return frames.mean_e[None, None], mean_variance_e2(frames)[None, None]

    def psf_model(self, settings: PsfSettings, nolls: Sequence[int], device: str) -> LightPath:
        return light_path(settings, nolls, device=device, dtype=torch.float64, rough_derivatives=True)

    def twin(self, problem: ImageFit, solution: Solution, law: NcpaLaw | None) -> TwinCheck | None:
        known_nm = problem.model.psf.settings.known.total_nm
        return check_twin(problem, solution.values[:1], float(solution.objective[0]), law, known_nm)[0]


class EveryFrame(Scheme):
    """Every frame by a vector of its own, and the coefficients averaged."""

    def data(self, frames: Frames) -> tuple[torch.Tensor, torch.Tensor]:
        return frames.images_e[:, None], frames.noise.variance_e2(frames.mean_e)[None, None]

    def fits(self, frames: Frames) -> int:
        return len(frames.images_e)

    def start(self, frames: Frames, problem: ImageFit) -> torch.Tensor:
        """See `Scheme.start`: what a few frames agree on, and tip and tilt of every frame by itself."""
        model = problem.model.psf
        median_nm = median_of_frames_nm(model, frames.images_e, frames.good, frames.noise, ROUGH_ITERATIONS)
        x = start_at_centroids(frames, problem)
        modelled = start_tilts_nm(model.images(median_nm[None]).double().cpu(), model.settings)
        x[:, :2] += median_nm[:2] - modelled
        x[:, 2 : len(median_nm)] = median_nm[2:]
        return x

    def solve(
        self, problem: ImageFit, start: torch.Tensor, max_iterations: int, report: Report | None
    ) -> Solution:
        return fit_frames(problem, start, max_iterations=max_iterations, report=report)

    def estimates(self, frames: Frames, problem: ImageFit, solution: Solution) -> Estimates:
        modes = problem.layout.modes
        usable = np.array([status != INVALID for status in solution.status])
        values = solution.values[torch.as_tensor(usable)].mean(0, keepdim=True)
        frames_nm = np.where(usable[:, None], solution.values[:, modes].numpy(), np.nan)
        return Estimates(values, values[0, modes].numpy(), frames_nm)


class AllFrames(Scheme):
    """All frames, brought to the same flux, by one vector."""

    def data(self, frames: Frames) -> tuple[torch.Tensor, torch.Tensor]:
        images, flux = frames.images_e, frames.flux_e
        variance = frames.noise.variance_e2(frames.mean_e)
        return (images * (flux.mean() / flux)[:, None, None].to(images.dtype))[None], variance[None, None]


def start_at_centroids(
    frames: Frames, problem: ImageFit, start_nm: torch.Tensor | np.ndarray | None = None
) -> torch.Tensor:
    """Return the start with tip and tilt from the centroids and no aberrations, or with given first modes.

    The `problem` is that of these `frames`, and `start_nm` (modes,) begins with Noll 2. Returns (batch,
    parameters).
    """
    x = torch.empty(len(problem.images), problem.layout.size, dtype=torch.float64)
    for block in blocks(len(x)):
        x[block] = _centred(problem.images[block], frames.good, problem)
    if start_nm is not None:
        common = min(len(start_nm), len(problem.layout.nolls))
        x[:, :common] = torch.as_tensor(start_nm[:common])
    return x


def _centred(images: torch.Tensor, good: torch.Tensor, problem: ImageFit) -> torch.Tensor:
    """Start of members from images (b, repeats, pixels): flux, and tip and tilt of the centroid."""
    settings, first = problem.model.psf.settings, images.double().mean(1).cpu()
    x = problem.layout.start(first)
    masked = first.reshape(-1, *settings.window) * good
    x[:, :2] = start_tilts_nm(masked, settings)
    return x


def linear_estimates(frames: Frames, problem: ImageFit, solution: Solution) -> Estimates:
    """Return estimates of one vector for all frames, and of every frame by one linear step from it.

    The mean of the latter is the solution, their scatter carries photon noise, speckle and real changes. The
    `problem` of these `frames` has one member.
    """
    x, layout = solution.values[:1], problem.layout
    added, read = whole_wavefront(problem, x[0])
    model_e, jacobian = problem.predict_and_jacobian(x)
    weight = problem.curvature_weights(x, model_e)[0]
    gain = read @ solution.covariance[0] @ (jacobian[0].double().cpu() * weight)
    total = x[0, layout.modes] + added
    return Estimates(x, total.numpy(), (total + frames.responses(gain)).numpy())


MEAN_IMAGE, EVERY_FRAME, ALL_FRAMES = MeanImage(), EveryFrame(), AllFrames()
SCHEMES: dict[Fits, Scheme] = {"mean image": MEAN_IMAGE, "every frame": EVERY_FRAME, "all frames": ALL_FRAMES}


def scheme_of(options: CalibrationOptions) -> Scheme:
    """Return what the method of the `options` fits to what."""
    return SCHEMES[METHODS[options.method].fits]


FEW = 10  # frames whose mean curvature stands for that of all
LEAST_SQUARES_EVALUATIONS = 4
EVALUATIONS = 50  # after so many, most frames have converged


@torch.no_grad()
def fit_frames(
    problem: ImageFit,
    start: torch.Tensor,
    *,
    max_iterations: int,
    report: Callable[[int], None] | None = None,
) -> Solution:
    """Minimise a batch of fits of single frames from `start` (frames, parameters), without bounds.

    After the first linearisation of its own a frame is evaluated `max_iterations` times at most. `report`
    gets the number of frames that were finished. In the solution, `iterations` counts evaluations;
    `covariance` is the mean of a few frames' for those that never had a linearisation of their own.
    """
    squares = problem.with_loss(replace(GAUSSIAN, whitened=problem.loss.whitened))
    found = polish(squares, _with_shared_curvature(squares, start), LEAST_SQUARES_EVALUATIONS)
    shared = _with_shared_curvature(problem, found.values)
    found = polish(problem, replace(shared, iterations=found.iterations), EVALUATIONS)
    open_before = len(start)
    for spent in range(0, max_iterations, EVALUATIONS):
        left = _unfinished(found)
        if report is not None:
            report(open_before - len(left))
        if len(left) == 0:
            return found
        more = min(EVALUATIONS, max_iterations - spent)
        found, open_before = _by_themselves(problem, found, left, more), len(left)
    if report is not None:
        report(open_before)
    return found


def _by_themselves(problem: ImageFit, found: Solution, which: torch.Tensor, evaluations: int) -> Solution:
    """Some members continued, each from a linearisation of its own."""
    some = problem.members(which)
    near = solve(some, found.values[which], max_iterations=1)
    better = polish(some, near, evaluations)
    better = replace(better, iterations=found.iterations[which] + better.iterations)
    return found.updated(which, better, torch.ones(len(which), dtype=torch.bool))


def _with_shared_curvature(problem: ImageFit, x: torch.Tensor) -> Solution:
    """These parameters with the inverse of the mean Hessian of a few members."""
    few = torch.linspace(0, len(x) - 1, min(FEW, len(x))).round().long()
    _, _, hessian = problem.normal_equations(x[few], few)
    hessian = hessian[torch.isfinite(hessian).all((1, 2))].mean(0, keepdim=True)
    covariance = scaled_inverse(hessian).expand(len(x), -1, -1)
    unknown = torch.full((len(x),), float("nan"), dtype=torch.float64)
    return Solution(x, covariance, [MAX_ITERATIONS] * len(x), torch.zeros(len(x), dtype=torch.int64), unknown)


def _unfinished(found: Solution) -> torch.Tensor:
    """Members that can be improved, those that are stuck included."""
    return torch.tensor([i for i, s in enumerate(found.status) if s not in (CONVERGED, INVALID)]).long()
