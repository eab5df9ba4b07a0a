"""Other minima of the fit of all modes, for one that ended in a wrong one.

Opposite sides of a displaced stop are degenerate to first order, and which is the right one shows only once
all modes are in the model. So the fit is repeated from the opposite side, and from every side where the stop
came to rest at its place.

Where the modes beyond the closed basis hold nearly as much of the wavefront as those in it, the closed basis
bends to imitate them, and the fit of all modes that begins there ends in a wrong minimum, with χ²/ν several
times too large. The image has many such minima, each a little better than the next. Two means lead on:

- *Softened weights.* Errors of the pixels far above those of the noise blur the minima into few. They are
  lowered step by step, and each fit begins where the one before ended. All errors may be larger by a factor,
  or each by a part of its pixel's light, which gives faint speckles as much to say as the core.
- *Shakes.* The best minimum so far is disturbed at random and fitted again; a better one takes its place
  (basin hopping; Wales & Doye 1997, J. Phys. Chem. A 101, 5111).

A fit of 230 modes from nearby costs about a second, as its steps share Hessians. Where the model lacks
something else, softened weights lead back to where the fit has ended, or one wrongly declared fact explains
what the best minimum misses (`causes`), and shakes are left out: they gain a few per cent of χ² in a hundred
seconds. They also end where they have taken `SHAKEN_TIMES` as many iterations as the softened weights: a
count, and not a time, so that the end is the same on every machine.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import cycle, islice, product

import numpy as np
import torch

from irlos_pipe.conventions.modes import CORRECTED_NOLLS, DEFOCUS
from irlos_pipe.estimate.causes import EXPLAINED, Asked, causes_of_misfit
from irlos_pipe.estimate.image_fit import Fit
from irlos_pipe.estimate.methods import FIRST, CubeFit
from irlos_pipe.estimate.open_fit import ROUGHLY, Opened, OpenFit, finished, fitted_from, settled
from irlos_pipe.estimate.starts import on_other_sides
from irlos_pipe.numerics.solver import INVALID, Solution, solve

SEED = 20
SHAKES, PATIENCE = 16, 8  # shakes from one start at most, and in a row without a better minimum
SHAKEN_TIMES = 4  # shakes take at most so many times the iterations of softened weights
ITERATIONS = 40  # of every fit on the way
PRIOR_PART = 0.3  # part of the standard deviation of the prior, for shakes by it
BACK_NM = 10.0  # RMS in Noll 4–30 within which a fit has led back; other minima are 20 to 200 away
SOFTER = 500.0  # times χ²/ν: the factor on the variance that widens errors to the distance of other minima


@dataclass(frozen=True)
class Softening:
    """Larger variance of the pixels: `factor` times that of the noise, plus (`part` of the light)²."""

    factor: float = 1.0
    part: float = 0.0

    def of(self, problem: OpenFit) -> OpenFit:
        """Return a `problem` with the weights of the larger variance."""
        variance = self.factor * problem.root_weight.double() ** -2
        variance = variance + (self.part * problem.images.double()) ** 2
        return problem.reweighed((variance**-0.5).to(problem.root_weight.dtype))


def likelier_side(opened: Opened, max_iterations: int, *, settle: bool = True) -> Opened:
    """Return a fit of all modes, or a likelier one with a fact of the instrument on another side.

    For `max_iterations` and `settle` see `open_basis`.
    """
    problem, best = opened.problem, opened
    sides = on_other_sides(problem.model.effects, problem.layout.effect_values, opened.x)
    for start in [start for effect, start, _ in sides if effect.base.fact]:
        found = fitted_from(problem.exact, start, opened.law, max_iterations)
        # what a rough fit leaves to gain is less than this
        if settle and found is not None:
            hopeless = found.objective > best.objective + found.problem.tolerance
            found = None if hopeless else finished(found, max_iterations)
        if found is not None and found.objective < best.objective:
            best = found
    return best


Path = tuple[Softening, ...]
EXACT = Softening()
BY_NOISE: Path = (*(Softening(factor) for factor in (1000.0, 100.0, 30.0, 10.0, 3.0)), EXACT)
BY_LIGHT: Path = (*(Softening(part=part) for part in (1.0, 0.5, 0.2, 0.1, 0.05, 0.02)), EXACT)


def likelier_minimum(task: CubeFit, closed: Fit, opened: Opened, most: float) -> Opened:
    """Return a fit of all modes, or the likeliest of several minima where it has ended in a wrong one.

    It has if χ²/ν is above nominal, `most`, although the modes beyond the closed basis explain most of what
    the fit of that basis, `closed`, misses; else the model lacks something that no other minimum would bring.
    The fit of all modes from there is `opened`. The search ends at the first nominal χ²/ν, after four fits
    with softened weights if all of them lead back or one fact explains what the best of them misses, and else
    after `SHAKES` shakes of each at most.
    """
    problem, chi2_nu = opened.problem, opened.chi2_nu
    if chi2_nu <= most or chi2_nu > (1 - EXPLAINED) * closed.chi2_nu:
        return opened
    rough = problem.to(ROUGHLY)
    search = _Search(rough.hastened(), most, np.random.default_rng(SEED))
    begun = task.problem(problem.model.effects.effects)  # the closed basis may hold some of them
    starts = [begun.carried(x, problem) for x in task.starts(begun)]
    best = search.best_from(starts, opened.x)
    if best is None or _objective(best) >= opened.objective:
        return opened
    limit = task.options.max_iterations
    found = settled(rough, search.problem, best.values, opened.law, limit, best.values)
    return opened if found is None else found


@dataclass
class _Search:
    """Fits of one image by all modes, until χ²/ν is at `most` that, or no more iterations are `allowed`."""

    problem: OpenFit
    most: float
    rng: np.random.Generator
    spent: int = 0
    allowed: float = np.inf

    def best_from(self, starts: Sequence[torch.Tensor], known: torch.Tensor) -> Solution | None:
        """The likeliest minimum found from some starts.

        None where all lead to the `known` one, (1, parameters), or numbers are not finite.
        """
        found: list[Solution] = []
        for path, start in product((BY_NOISE, BY_LIGHT), starts):
            found += self._led(start, path)
            if found and self._is_nominal(found[-1]):
                return found[-1]
        corrected = [i for i, noll in enumerate(self.problem.layout.nolls) if noll in CORRECTED_NOLLS]
        if all(float((one.values - known)[0, corrected].norm()) < BACK_NM for one in found):
            return None
        found.sort(key=_objective)
        self.allowed = (1 + SHAKEN_TIMES) * self.spent
        asked = Asked(None, self.most)
        facts = causes_of_misfit(self.problem, found[0].values, asked, facts_only=True)
        if any(one.explains > EXPLAINED for one in facts):
            return found[0]
        for place, one in enumerate(found):
            found[place] = self._shaken(one)
            if self._is_nominal(found[place]):
                break
        return min(found, key=_objective)

    def _shaken(self, best: Solution) -> Solution:
        """The likeliest of the minima around one, and around those that are found."""
        failed = 0
        for shake, path in islice(cycle(SHAKEN), SHAKES):
            if self._is_nominal(best) or failed == PATIENCE or self.spent > self.allowed:
                break
            other = min([best, *self._led(shake(self.problem, best.values, self.rng), path)], key=_objective)
            failed = failed + 1 if other is best else 0
            best = other
        return best

    def _led(self, start: torch.Tensor, path: Path) -> list[Solution]:
        """The end of a path from a start; nothing where numbers are not finite."""
        for softening in path:
            solution = solve(softening.of(self.problem), start, max_iterations=ITERATIONS)
            self.spent += int(solution.iterations[0])
            if solution.status[0] == INVALID:
                return []
            start = solution.values
        return [solution]

    def _is_nominal(self, solution: Solution) -> bool:
        return float(self.problem.reduced_chi2(solution.values)[0]) <= self.most


def _objective(solution: Solution) -> float:
    return float(solution.objective[0])


def by_prior(problem: OpenFit, x: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Return the place `x`, (1, parameters), with modes beyond focus disturbed by a part of their prior."""
    nolls = torch.tensor(problem.layout.nolls)
    precision = problem.prior_precision[0, problem.layout.modes]
    free = (nolls > DEFOCUS) & (precision > 0)
    sigma_nm = torch.where(free, PRIOR_PART * precision**-0.5, 0.0)
    return _moved(x, sigma_nm * torch.from_numpy(rng.standard_normal(len(nolls))))


def by_curvature(problem: OpenFit, x: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Return the place `x`, (1, parameters), with modes drawn from what weights softened by the misfit allow.

    The image changes little where the modes change most.
    """
    factor = SOFTER * float(problem.reduced_chi2(x)[0])
    modes = problem.layout.modes
    hessian = Softening(factor).of(problem).normal_equations(x, FIRST)[2][0, modes, modes]
    root, failed = torch.linalg.cholesky_ex(hessian)
    if failed:  # without a prior, some modes may have no curvature
        return by_prior(problem, x, rng)
    drawn = torch.from_numpy(rng.standard_normal((len(hessian), 1)))
    return _moved(x, torch.linalg.solve_triangular(root.mT, drawn, upper=True)[:, 0])


def _moved(x: torch.Tensor, by_nm: torch.Tensor) -> torch.Tensor:
    """The place `x`, its modes moved."""
    moved = x.clone()
    moved[0, : len(by_nm)] += by_nm
    return moved


Shake = Callable[[OpenFit, torch.Tensor, np.random.Generator], torch.Tensor]
# Kinds of shakes, each with its way back.
SHAKEN: tuple[tuple[Shake, Path], ...] = (
    (by_curvature, (EXACT,)),
    (by_prior, (Softening(30.0), Softening(3.0), EXACT)),
    (by_prior, (Softening(part=0.2), Softening(part=0.05), EXACT)),
    (by_curvature, (Softening(part=0.1), EXACT)),
)
