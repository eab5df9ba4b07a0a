"""Fits of one cube: where they begin, and where they begin again if they end in a wrong minimum."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_errors import nominal_of
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.image_fit import ImageFit, Layout, masked_variance
from irlos_pipe.estimate.methods import EVERY_FRAME, Report, scheme_of, start_at_centroids
from irlos_pipe.estimate.starts import (
    START_HIGHEST_NOLL,
    a_wave_off,
    better,
    is_plausible,
    median_of_frames_nm,
)
from irlos_pipe.numerics.levenberg_marquardt import scaled_inverse
from irlos_pipe.numerics.solution import CONVERGED, INVALID, MAX_ITERATIONS, Solution
from irlos_pipe.optics.light_path import LightPath

FIRST = torch.zeros(1, dtype=torch.int64)  # the only member of a batch of one

Fit = tuple[ImageFit, Solution]


@dataclass(frozen=True)
class CubeFit:
    """The means to fit one cube, whatever the effects in the model."""

    frames: Frames
    psf: LightPath
    options: CalibrationOptions
    # (modes,), where every fit begins, from Noll 2 on; else each begins from none, and from elsewhere if it
    # ends in a wrong minimum
    start_nm: np.ndarray | None
    report: Report | None  # called with the number of finished frames

    def fit(self, effects: Sequence[Effect], near: Fit | None = None) -> Fit:
        """Fit with these effects, from scratch or from the modes of another fit, `near`."""
        problem = self._problem(ImageModel(self.psf, effects))
        if self.start_nm is None:
            start = scheme_of(self.options).start(self.frames, problem)
        else:
            start = start_at_centroids(self.frames, problem, self.start_nm)
        if near is not None:
            start[:, problem.layout.modes] = near[1].values[:, near[0].layout.modes]
        solution = self._solve(problem, start, self.report)
        alone = near is None and self.start_nm is None
        if alone and METHODS[self.options.method].effects and not self._is_plausible(problem, solution):
            solution = better(solution, self._solve(problem, self._second_start(problem)))
            solution = self._by_whole_waves(problem, solution)
        return problem, solution

    def starts(self, problem: ImageFit) -> list[torch.Tensor]:
        """Return where a fit that knows nothing may begin, and one with the low modes of single frames."""
        return [scheme_of(self.options).start(self.frames, problem), self._second_start(problem)]

    def released(self, effects: Sequence[Effect], held: Fit) -> tuple[ImageFit, torch.Tensor]:
        """Return the problem with these effects, and where a fit with some of them, `held`, is in it.

        Those that are free there are so here as well. The fit may have more modes.
        """
        problem = self._problem(ImageModel(self.psf, effects))
        old, new = held[0].layout, problem.layout
        found = held[1].values[0]
        values = new.start(problem.images.double().mean(1).cpu())
        values[0, new.modes], values[0, -2:] = found[: len(new.nolls)], found[-2:]
        pieces = held[0].model.effects.split(found[old.effect_values])
        starts = problem.model.effects.split(values[0, new.effect_values])
        joined = [pieces[one] if len(pieces.get(one, ())) else start for one, start in starts.items()]
        values[0, new.effect_values] = torch.as_tensor(np.concatenate([np.empty(0), *joined]))
        return problem, values

    def _by_whole_waves(self, problem: ImageFit, solution: Solution) -> Solution:
        """The solution, or better ones with parts of the pupil whole waves nearer or further."""
        while not self._is_plausible(problem, solution):
            starts = a_wave_off(problem, solution.values[:1])
            if not starts:
                break
            nearest = min(starts, key=lambda one: float(problem.objective(one, FIRST)))
            found = better(solution, self._solve(problem, nearest))
            if found is solution:
                break
            solution = found
        return solution

    def _is_plausible(self, problem: ImageFit, solution: Solution) -> bool:
        return is_plausible(problem, solution, nominal_of(self.frames, problem, solution.values).most)

    def _problem(self, model: ImageModel) -> ImageFit:
        nolls, prior = self.psf.nolls, self.options.prior
        sigma_nm = None if prior is None else prior.sigma_nm(nolls)
        layout = Layout(nolls, model.effects.parameters, prior_sigma_nm=sigma_nm)
        images, variance = scheme_of(self.options).data(self.frames)
        variance = masked_variance(variance, self.frames.good)
        data = (one.flatten(-2).to(self.psf.device) for one in (images, variance))
        return ImageFit(model, layout, *data, loss=self.options.loss_function)

    def _second_start(self, problem: ImageFit) -> torch.Tensor:
        """The start with the low modes of single frames."""
        nolls = [noll for noll in self.psf.nolls if noll <= START_HIGHEST_NOLL]
        model, cube = EVERY_FRAME.psf_model(self.psf.settings, nolls, self.psf.device), self.frames
        median_nm = median_of_frames_nm(model, cube.images_e, cube.good, cube.noise)
        return start_at_centroids(cube, problem, median_nm)

    def _solve(self, problem: ImageFit, start: torch.Tensor, report: Report | None = None) -> Solution:
        limit = self.options.max_iterations
        if self.options.optimiser == "lbfgs":
            return solve_lbfgs(problem, start, max_iterations=3 * limit)
        return scheme_of(self.options).solve(problem, start, limit, report)


HISTORY = 20
GRADIENT_TOLERANCE = 1e-2  # per standard error of a parameter


@torch.enable_grad()
def solve_lbfgs(problem: ImageFit, start: torch.Tensor, *, max_iterations: int = 300) -> Solution:
    """Minimise the sum of all members' objectives with PyTorch's L-BFGS (strong Wolfe line search).

    The variables are scaled by the curvature at the `start` (batch, parameters), so that nm, electrons and
    variances are of one size.
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
    x = (start + scale * u.detach()).clamp(problem.lower, problem.upper)
    evaluations = optimiser.state[u]["n_iter"]
    value, gradient, hessian = problem.normal_equations(x, everyone)
    small = (gradient.abs() * scale).amax(1) < 10 * GRADIENT_TOLERANCE * (2 * value).clamp_min(1).sqrt()
    finite = torch.isfinite(value)
    outcome = zip(small, finite, strict=True)
    status = [CONVERGED if s and f else MAX_ITERATIONS if f else INVALID for s, f in outcome]
    return Solution(x, scaled_inverse(hessian), status, torch.full((len(start),), evaluations), value)
