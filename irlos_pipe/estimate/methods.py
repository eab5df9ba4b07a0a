"""The ways to fit the images of a cube, their mean, every frame or all frames together, and where they begin.

The frames of a cube are very similar: what their fits share is computed once. The curvature at a few frames
serves all others, and what it misses is learnt from the gradients along the way (`quasi_newton`). Plain least
squares come first, as their curvature hardly changes. Only frames that are not done then get a linearisation
of their own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_errors import nominal_of
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions, Fits, TwinCheck
from irlos_pipe.estimate.cube import Frames, mean_variance_e2
from irlos_pipe.estimate.image_fit import Fit, ImageFit, Layout, masked_variance, whole_wavefront
from irlos_pipe.estimate.starts import (
    FEW_FRAMES,
    a_wave_off,
    better,
    check_twin,
    evenly,
    median_of_frames_nm,
    start_tilts_nm,
)
from irlos_pipe.frames.recording import blocks
from irlos_pipe.numerics.loss import GAUSSIAN
from irlos_pipe.numerics.parallel import joined_map
from irlos_pipe.numerics.quasi_newton import polish
from irlos_pipe.numerics.solver import CONVERGED, INVALID, MAX_ITERATIONS, Solution, scaled_inverse, solve
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.optics.psf_settings import PsfSettings

ROUGH_ITERATIONS = 6  # iterations of the few frames whose median is the start of all others
Report = Callable[[int], Any]


def silent(count: int) -> None:
    pass


@dataclass(frozen=True)
class Estimates:
    """Estimates of the modes from a fit."""

    values: torch.Tensor  # (1, parameters), of all frames together
    zernike_nm: np.ndarray  # (modes,), the whole static wavefront
    frames_nm: np.ndarray  # (frames, modes), the same of every frame; NaN where its fit failed


class Scheme:
    """Which images of a cube are fitted, by how many vectors: all, brought to the same flux, by one."""

    def data(self, frames: Frames) -> tuple[torch.Tensor, torch.Tensor]:
        """Images (batch, repeats, rows, columns) [e-], and their variance, which broadcasts to them."""
        images, flux = frames.images_e, frames.flux_e
        variance = frames.noise.variance_e2(frames.mean_e)
        return (images * (flux.mean() / flux)[:, None, None].to(images.dtype))[None], variance[None, None]

    def psf_model(self, settings: PsfSettings, nolls: Sequence[int], device: str) -> LightPath:
        """PSF model for `settings` with the modes `nolls` on a `device`, as precise as the images need."""
        return light_path(settings.for_single_frames(), nolls, device=device)

    def start(self, frames: Frames, problem: ImageFit) -> torch.Tensor:
        """Return the start of the `problem` of these `frames` when nothing is known, (batch, parameters)."""
        return start_at_centroids(frames, problem)

    def solve(self, problem: ImageFit, start: torch.Tensor, max_iterations: int, report: Report) -> Solution:
        """Minimise the `problem` from a `start` in `max_iterations`; see `solve` for `report`."""
        return solve(problem, start, max_iterations=max_iterations, report=report)

    def estimates(self, frames: Frames, fit: Fit) -> Estimates:
        """Return the modes from the `fit` of these `frames`."""
        return linear_estimates(frames, fit)

    def twin(self, fit: Fit, law: NcpaLaw | None) -> TwinCheck | None:
        """Compare a `fit` with its twin under a `law`, where that is of use."""
        return None


class MeanImage(Scheme):
    """The mean image by one vector; it is so precise that rounding of float32 would stall its fit."""

    def data(self, frames: Frames) -> tuple[torch.Tensor, torch.Tensor]:
        return frames.mean_e[None, None], mean_variance_e2(frames)[None, None]

    def psf_model(self, settings: PsfSettings, nolls: Sequence[int], device: str) -> LightPath:
        return light_path(settings, nolls, device=device, dtype=torch.float64, rough_derivatives=True)

    def twin(self, fit: Fit, law: NcpaLaw | None) -> TwinCheck | None:
        known_nm = fit.problem.model.psf.settings.known.total_nm
        return check_twin(fit.problem, fit.solution, law, known_nm)[0]


class EveryFrame(Scheme):
    """Every frame by a vector of its own, and the coefficients averaged."""

    def data(self, frames: Frames) -> tuple[torch.Tensor, torch.Tensor]:
        return frames.images_e[:, None], frames.noise.variance_e2(frames.mean_e)[None, None]

    def start(self, frames: Frames, problem: ImageFit) -> torch.Tensor:
        """See `Scheme.start`: what a few frames agree on, and tip and tilt of every frame by itself."""
        model = problem.model.psf
        median_nm = median_of_frames_nm(model, frames, ROUGH_ITERATIONS)
        x = start_at_centroids(frames, problem)
        modelled = start_tilts_nm(model.images(median_nm[None]).double(), model.settings)
        x[:, :2] += median_nm[:2] - modelled
        x[:, 2 : len(median_nm)] = median_nm[2:]
        return x

    def solve(self, problem: ImageFit, start: torch.Tensor, max_iterations: int, report: Report) -> Solution:
        return fit_frames(problem, start, max_iterations=max_iterations, report=report)

    def estimates(self, frames: Frames, fit: Fit) -> Estimates:
        modes, solution = fit.problem.layout.modes, fit.solution
        usable = np.array([status != INVALID for status in solution.status])
        values = solution.values[torch.as_tensor(usable)].mean(0, keepdim=True)
        frames_nm = np.where(usable[:, None], solution.values[:, modes].numpy(), np.nan)
        return Estimates(values, values[0, modes].numpy(), frames_nm)


def start_at_centroids(
    frames: Frames, problem: ImageFit, start_nm: torch.Tensor | np.ndarray | None = None
) -> torch.Tensor:
    """Return the start with tip and tilt from the centroids and no aberrations, or with given first modes.

    The `problem` is that of these `frames`, and `start_nm` (modes,) begins with Noll 2. Returns (batch,
    parameters).
    """
    settings, good = problem.model.psf.settings, frames.good.to(problem.device)

    def start(block: slice) -> tuple[torch.Tensor]:
        images = problem.images[block].double().mean(1)
        own = problem.layout.start(images)
        own[:, :2] = start_tilts_nm(images.reshape(-1, *settings.window) * good, settings)
        return (own,)

    (x,) = joined_map(start, blocks(len(problem.images)), len(problem.images))
    if start_nm is not None:
        common = min(len(start_nm), len(problem.layout.nolls))
        x[:, :common] = torch.as_tensor(start_nm[:common])
    return x


def linear_estimates(frames: Frames, fit: Fit) -> Estimates:
    """Return estimates of one vector for all frames, and of every frame by one linear step from it.

    The mean of the latter is the solution, their scatter carries photon noise, speckle and real changes. The
    `fit` of these `frames` has one member.
    """
    problem, x, layout = fit.problem, fit.x, fit.problem.layout
    added, read = whole_wavefront(problem, x[0])
    model_e, jacobian = problem.predict_and_jacobian(x)
    weight = problem.curvature_weights(x, model_e)[0]
    gain = read @ fit.solution.covariance[0] @ (jacobian[0].double().cpu() * weight)
    total = x[0, layout.modes] + added
    return Estimates(x, total.numpy(), (total + frames.responses(gain)).numpy())


MEAN_IMAGE, EVERY_FRAME = MeanImage(), EveryFrame()
SCHEMES: dict[Fits, Scheme] = {"mean image": MEAN_IMAGE, "every frame": EVERY_FRAME, "all frames": Scheme()}


def scheme_of(options: CalibrationOptions) -> Scheme:
    """Return what the method of the `options` fits to what."""
    return SCHEMES[METHODS[options.method].fits]


LEAST_SQUARES_EVALUATIONS = 4
EVALUATIONS = 50  # after so many, most frames have converged


@torch.no_grad()
def fit_frames(
    problem: ImageFit,
    start: torch.Tensor,
    *,
    max_iterations: int,
    report: Report = silent,
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
        # those that can be improved, those that are stuck included
        left = torch.tensor([i for i, s in enumerate(found.status) if s not in (CONVERGED, INVALID)]).long()
        report(open_before - len(left))
        if len(left) == 0:
            return found
        more = min(EVALUATIONS, max_iterations - spent)
        found, open_before = _by_themselves(problem, found, left, more), len(left)
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
    few = evenly(len(x), FEW_FRAMES)
    _, _, hessian = problem.normal_equations(x[few], few)
    hessian = hessian[torch.isfinite(hessian).all((1, 2))].mean(0, keepdim=True)
    covariance = scaled_inverse(hessian).expand(len(x), -1, -1)
    unknown = torch.full((len(x),), float("nan"), dtype=torch.float64)
    return Solution(x, covariance, [MAX_ITERATIONS] * len(x), torch.zeros(len(x), dtype=torch.int64), unknown)


FIRST = torch.zeros(1, dtype=torch.int64)  # the only member of a batch of one


@dataclass(frozen=True)
class CubeFit:
    """The means to fit one cube, whatever the effects in the model."""

    frames: Frames
    psf: LightPath
    options: CalibrationOptions
    # (modes,), where every fit begins, from Noll 2 on; else each begins from none, and from elsewhere if it
    # ends in a wrong minimum
    start_nm: np.ndarray | None = None
    report: Report = silent  # called with the number of finished frames

    def fit(self, effects: Sequence[Effect], near: Fit | None = None) -> Fit:
        """Fit with these effects, from scratch or from the modes of another fit, `near`."""
        problem = self.problem(effects)
        if self.start_nm is None:
            start = scheme_of(self.options).start(self.frames, problem)
        else:
            start = start_at_centroids(self.frames, problem, self.start_nm)
        if near is not None:
            start[:, problem.layout.modes] = near.solution.values[:, near.problem.layout.modes]
        solution = self._solve(problem, start, self.report)
        alone = near is None and self.start_nm is None
        if alone and METHODS[self.options.method].effects and not self._is_plausible(problem, solution):
            solution = better(solution, self._solve(problem, self.starts(problem)[1]))
            solution = self._by_whole_waves(problem, solution)
        return Fit(problem, solution)

    def starts(self, problem: ImageFit) -> list[torch.Tensor]:
        """Return where a fit that knows nothing may begin, and one with the low modes of single frames."""
        nolls = [noll for noll in self.psf.nolls if noll <= HIGHEST_REPORTED_NOLL]
        model, cube = EVERY_FRAME.psf_model(self.psf.settings, nolls, self.psf.device), self.frames
        start = start_at_centroids(cube, problem, median_of_frames_nm(model, cube))
        return [scheme_of(self.options).start(cube, problem), start]

    def _by_whole_waves(self, problem: ImageFit, solution: Solution) -> Solution:
        """The solution, or better ones with parts of the pupil whole waves nearer or further."""
        starts = a_wave_off(problem, solution.values[:1])
        if not starts or self._is_plausible(problem, solution):
            return solution
        nearest = min(starts, key=lambda one: float(problem.objective(one, FIRST)))
        found = better(solution, self._solve(problem, nearest))
        return solution if found is solution else self._by_whole_waves(problem, found)

    def _is_plausible(self, problem: ImageFit, solution: Solution) -> bool:
        """Whether the first solution is converged, with a nominal χ²/ν."""
        most = nominal_of(self.frames, problem, solution.values).most
        return bool(solution.converged[0] and Fit(problem, solution).chi2_nu <= most)

    def problem(self, effects: Sequence[Effect]) -> ImageFit:
        """Return the problem with these effects, which begins nowhere."""
        model, nolls, prior = ImageModel(self.psf, effects), self.psf.nolls, self.options.prior
        sigma_nm = None if prior is None else prior.sigma_nm(nolls)
        layout = Layout(nolls, model.effects.parameters, prior_sigma_nm=sigma_nm)
        images, variance = scheme_of(self.options).data(self.frames)
        variance = masked_variance(variance, self.frames.good)
        data = (one.flatten(-2).to(self.psf.device) for one in (images, variance))
        return ImageFit(model, layout, *data, loss=self.options.loss_function)

    def _solve(self, problem: ImageFit, start: torch.Tensor, report: Report = silent) -> Solution:
        limit = self.options.max_iterations
        if self.options.optimiser == "lbfgs":
            return solve_lbfgs(problem, start, 3 * limit)
        return scheme_of(self.options).solve(problem, start, limit, report)


HISTORY = 20
GRADIENT_TOLERANCE = 1e-2  # per standard error of a parameter


@torch.enable_grad()
def solve_lbfgs(problem: ImageFit, start: torch.Tensor, max_iterations: int) -> Solution:
    """Minimise the sum of all members' objectives with PyTorch's L-BFGS (strong Wolfe line search).

    The variables are scaled by the curvature at the `start` (batch, parameters), so that nm, electrons and
    variances are of one size. Whether it has converged is judged as of other fits, at a last step of these.
    """
    everyone = torch.arange(len(start))
    _, _, hessian = problem.normal_equations(start, everyone)
    scale = torch.diagonal(hessian, dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    u = torch.zeros_like(start, requires_grad=True)
    optimiser = torch.optim.LBFGS(
        [u],
        max_iter=max_iterations,
        history_size=HISTORY,
        line_search_fn="strong_wolfe",
        tolerance_grad=GRADIENT_TOLERANCE,
        tolerance_change=1e-12,
    )

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        total = problem.objective(start + scale * u, everyone).sum()
        total.backward()
        return total

    optimiser.step(closure)
    ended = solve(problem, start + scale * u.detach(), max_iterations=1)
    return replace(ended, iterations=torch.full((len(start),), optimiser.state[u]["n_iter"]))
