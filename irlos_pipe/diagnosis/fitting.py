"""Fits of the mean training images with one set of effects or another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.diagnosis.cube import Stack, Stacks
from irlos_pipe.diagnosis.fitted import POINTING, Fitted, JointFit
from irlos_pipe.diagnosis.options import DRIFT_NM
from irlos_pipe.diagnosis.view import View
from irlos_pipe.effects import Effect
from irlos_pipe.effects.effect_set import EffectSet
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.estimate.ncpa_prior import NcpaPrior
from irlos_pipe.estimate.starts import start_tilts_nm
from irlos_pipe.estimate.twin import twin_of
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.numerics.problem import CHI2_TOLERANCE
from irlos_pipe.numerics.solution import INVALID, Solution

PRIOR_SCALE = 3.0  # width of the prior over the law of the NCPAs
MAX_ITERATIONS = 60
PATIENCE = 4  # times that a fit goes on at most
CONVERGED = 1.0  # fall of χ², in units of χ²/ν where the model misfits, below which a fit has converged
SAME_IMAGE = 1e-6  # χ² between two images that differ by rounding
EXPLORING = 30  # iterations after which it is known whether a fit is promising
ROUGHLY = 0.1  # fall of χ² ahead, in the same units, at which that is known


class Fitter:
    """Fits the mean images of some recordings with any effects."""

    def __init__(self, views: Sequence[View], stack: Stacks, drift_nm: float = DRIFT_NM):
        self.views, self.stack, self.drift_nm = views, stack, drift_nm

    def of(self, stack: Stacks, views: Sequence[View] = ()) -> Fitter:
        """The same for other data, or other `views` of them."""
        return Fitter(views or self.views, stack, self.drift_nm)

    def fit(self, effects: Sequence[Effect], near: Fitted | None = None) -> Fitted:
        """Fit `effects` from zero wavefront, or from modes, flux and background of a fit `near` by."""
        problem = self.problem(effects, self.views)
        return self._solved(problem, self.start(problem, near))

    def explored(
        self, effects: Sequence[Effect], near: Fitted | None = None, iterations: int = EXPLORING
    ) -> Fitted:
        """Fit `effects` from a fit `near` by to a loose tolerance: enough to rank candidates."""
        problem = self.problem(effects, self.views, ROUGHLY)
        return self._solved(problem, self.start(problem, near), iterations)

    def finished(self, fitted: Fitted) -> Fitted:
        """What was explored, continued until it converges or falls no further, if patience allows."""
        for _ in range(PATIENCE):
            before = fitted
            if not np.isfinite(before.chi2) or (before.converged and not before.explored):
                break
            fitted = self._solved(self.problem(before.continued(), self.views), before.x)
            scatter = max(1.0, fitted.chi2 / fitted.problem.freedom)
            if not before.explored and before.chi2 - fitted.chi2 < CONVERGED * scatter:
                break
        return fitted

    def twin(self, fitted: Fitted) -> Fitted:
        """The fit that starts from the twin of another one, (φ(u) → −φ(−u))."""
        problem, start = fitted.problem, fitted.x.clone()
        modes = problem.layout.modes
        psf = self.views[0].psf
        start[:, modes] = twin_of(start[:, modes], psf.nolls, psf.settings.known.total_nm)
        for columns in problem.drifts.values():
            start[:, columns] = twin_of(start[:, columns], psf.nolls[POINTING:], {})
        return self._solved(problem, start)

    def most_plausible(self, found: Sequence[Fitted]) -> Fitted:
        """The best of several fits of one model, whose priors count however bad it is.

        Twins have the same image but for rounding, so the smaller aberration must win. While something is
        missing in the model, χ² is large and rounding of it would outweigh any prior: it is counted in
        units of its smallest value per degree of freedom. So it is of the scatter of speckles.
        """
        unit = max(1.0, min(one.chi2 / one.problem.freedom for one in found))

        def worth(one: int, other: int) -> float:
            return unit * self._scatter_between(found[one], found[other])

        return found[most_plausible([one.chi2 for one in found], [one.penalty for one in found], worth)]

    def rise_between(self, one: Fitted, other: Fitted) -> float:
        """By how much χ² and priors of `other` exceed those of `one`, χ² in units of its scatter."""
        chi2 = (other.chi2 - one.chi2) / self._scatter_between(one, other)
        return chi2 + other.penalty - one.penalty

    def _scatter_between(self, one: Fitted, other: Fitted) -> float:
        """Variance of the mean image along the difference of two models, in units of that of known noise."""
        if self.stack.photon_limited:
            return 1.0
        change = ((one.image_e - other.image_e) * self.stack.root)[:, None]
        power = float((change**2).sum())
        return max(1.0, float(self.stack.covariance_of(change)[0, 0]) / power) if power > SAME_IMAGE else 1.0

    def at(self, fitted: Fitted) -> Fitted:
        """The model of another fit, whose first recordings are the same, as it is.

        Further recordings point and shine like the first.
        """
        problem = self.problem(fitted.continued(), self.views)
        x = torch.zeros(1, problem.size, dtype=torch.float64)
        known, shared = fitted.problem, slice(0, problem.layout.effect_values.stop)
        x[:, shared] = fitted.x[:, shared]
        for moment, columns in known.drifts.items():
            if moment in problem.drifts:
                x[:, problem.drifts[moment]] = fitted.x[:, columns]
            elif moment in problem.moments:
                x[:, POINTING : POINTING + len(columns)] += fitted.x[:, columns]
        number_of_known = len(known.parts)
        for number in reversed(range(len(problem.parts))):
            like = number if number < number_of_known else 0
            x[:, problem.own_of(number)] = fitted.x[:, known.own_of(like)]
        solution = replace(fitted.solution, values=x)
        return Fitted(problem, solution, float(problem.chi2(x)), self.views)

    def problem(
        self, effects: Sequence[Effect], views: Sequence[View], tolerance: float = CHI2_TOLERANCE
    ) -> JointFit:
        whole = EffectSet(effects, views[0].psf.grids)
        pairs = zip(views, self.stack.parts, strict=True)
        parts = [_part(stack, view, view.seen(whole.effects, views)) for view, stack in pairs]
        return JointFit(parts, whole, [view.moment for view in views], self.drift_nm, tolerance)

    def start(self, problem: JointFit, near: Fitted | None = None) -> torch.Tensor:
        parts = zip(self.views, self.stack.parts, problem.parts, strict=True)
        x = problem.whole([_first_guess(*one)[0] for one in parts])[None]
        if near is not None:
            behind = problem.tail if problem.tail == near.problem.tail else 2
            common = min(len(problem.layout.nolls), len(near.problem.layout.nolls))  # both begin at tip
            x[:, :common] = near.x[:, :common]
            x[:, -behind:] = near.x[:, -behind:]
        return x

    def _solved(self, problem: JointFit, start: torch.Tensor, max_iterations: int = MAX_ITERATIONS) -> Fitted:
        """The fit; one that leaves what can be computed has an infinite χ², for nobody to choose."""
        try:
            solution = solve(problem, start, max_iterations=max_iterations)
            chi2 = float(problem.chi2(solution.values))
        except (ValueError, torch.linalg.LinAlgError):  # a wavelength out of the grid, a singular matrix
            solution, chi2 = _failed(start), float("inf")
        return Fitted(problem, solution, chi2, self.views)


def _failed(start: torch.Tensor) -> Solution:
    """No solution: where it began."""
    size = start.shape[1]
    return Solution(
        values=start,
        covariance=torch.full((1, size, size), torch.nan, dtype=torch.float64),
        status=[INVALID],
        iterations=torch.zeros(1, dtype=torch.int64),
        objective=torch.full((1,), torch.inf, dtype=torch.float64),
    )


def most_plausible(
    chi2: Sequence[float], penalty: Sequence[float], worth: Callable[[int, int], float]
) -> int:
    """Index of the best of several fits of one model, by χ² of the images and the `penalty` of the priors.

    The fall of χ² between two of them that counts as much as a unit of the penalty is their `worth`.
    """
    best = 0
    for one in range(1, len(chi2)):
        if (chi2[one] - chi2[best]) / worth(one, best) + penalty[one] - penalty[best] < 0:
            best = one
    return best


def _part(stack: Stack, view: View, effects: Sequence[Effect]) -> ImageFit:
    """The problem of one recording by itself, with the `effects` that act in it."""
    psf = view.psf
    model = ImageModel(psf, effects)
    law = view.conditions.ncpa_law
    prior = None if law is None else NcpaPrior(law, PRIOR_SCALE).sigma_nm(psf.nolls)
    layout = Layout(psf.nolls, model.effects.parameters, prior_sigma_nm=prior)
    data = (one[None, None].to(psf.device) for one in (stack.mean_e, stack.variance_e2))
    return ImageFit(model, layout, *data)


def _first_guess(view: View, stack: Stack, part: ImageFit) -> torch.Tensor:
    """Flux from the sum, tip and tilt from the centroid, nothing else, (1, parameters)."""
    settings = view.psf.settings
    masked = (stack.mean_e * (stack.root > 0))[None]
    x = part.layout.start(masked)
    image = masked.reshape(1, *settings.window)
    x[:, :2] = start_tilts_nm(image, settings)
    return x
