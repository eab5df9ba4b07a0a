"""The open static wavefront: from the closed basis on, as many modes as the window shows.

A fit of all modes at once ends in wrong minima. The closed basis, whose prior is the instrument's law, is
therefore fitted first, and all modes from there, with a prior whose law is fitted as well:
``std(n) = A (n/n₁)^(−p)`` by radial order n, by evidence.

One recording is one draw of every mode, but there are dozens of modes per parameter of the law. Around the
optimum the model is linear, so everything but A and p integrates out (Laplace; MacKay 1992, Neural Comput.
4, 415): with the curvature S of χ²/2 in the tail, all other parameters marginalised, and b = S â of the
unconstrained optimum â,

    ln evidence = ½ bᵀ(S + C⁻¹)⁻¹ b − ½ ln det(S + C⁻¹) − ½ ln det C,    C = diag std²(n)

Without a tail A falls to what the noise allows, and the modes beyond the closed basis with it.

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

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, islice, product

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from irlos_pipe.conventions.modes import CORRECTED_NOLLS, DEFOCUS
from irlos_pipe.conventions.units import MAS
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.causes import EXPLAINED, Asked, causes_of_misfit
from irlos_pipe.estimate.image_fit import Fit, ImageFit, Layout, like
from irlos_pipe.estimate.methods import FIRST, CubeFit
from irlos_pipe.estimate.starts import on_other_sides
from irlos_pipe.numerics.solver import INVALID, CheapGradientProblem, Solution, solve
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.zernike import noll_to_nm

MOST_ORDERS = 20  # radial orders, up to Noll 231: what the time allows
# Falls of χ² per mode still ahead at which the law may be fitted, and at which the fit is done: RMS steps of
# one standard error, and of a sixth.
ROUGHLY, SETTLED = 1.0, 0.03
IMITATED = 0.1  # of these where pupil or pixels are free: modes imitate them, and χ² hardly falls on the way
FINISHING = 2  # last iterations, with a Hessian of their own, which the errors need
JOINED = 0.5  # λ/D at the edge of the window: colours in the Hessian that lie less apart are one


def last_noll_of(order: int) -> int:
    return (order + 1) * (order + 2) // 2


def visible_order(settings: PsfSettings) -> int:
    """Return the radial order whose light still falls into the window, at most `MOST_ORDERS`.

    Light of order n has its maximum (n + 1)/π λ/D from the axis: that of ``J_{n+1}(π D a/λ)``, of which the
    transform of a mode consists (Noll 1976).
    """
    reach_rad = max(settings.window) * settings.pixel_scale_mas * MAS / 2
    seen = np.pi * reach_rad * settings.geometry.diameter_m / settings.shortest_m
    return min(int(seen) - 1, MOST_ORDERS)


@dataclass(frozen=True)
class Opened(Fit):
    """A fit of all modes."""

    problem: OpenFit
    law: TailLaw  # prior of the modes beyond the closed basis, as fitted


class OpenFit(CheapGradientProblem, ImageFit):
    """An `ImageFit` of so many modes that steps with an older Hessian pay."""

    @property
    def imitated(self) -> bool:
        """Whether modes can nearly imitate something else that is free: a pupil, or pixels."""
        effects = self.model.effects
        return bool(effects.free_at("pupil") or effects.free_at("sampling"))

    def hastened(self) -> OpenFit:
        """Return the same fit, the Hessian of its steps of a coarse light path.

        Unless the loss is robust, or pupil or pixels are free: there steps of a coarse one lead nowhere.
        """
        if self.reweighted or self.imitated:
            return self
        psf = self.model.psf
        coarse = like(psf, psf.settings.with_fewer_colours(JOINED), psf.nolls)
        return self._with(few_colours=ImageModel(coarse, self.model.effects.effects))

    @property
    def exact(self) -> OpenFit:
        """The same fit, the Hessian of its steps that of all colours."""
        return self._with(few_colours=None)

    def to(self, fall: float) -> OpenFit:
        """Return the same fit, done where less than this `fall` of χ² per mode is ahead."""
        part = IMITATED if self.imitated else 1.0
        return self.with_tolerance(fall * part * len(self.layout.nolls))

    def with_law(self, law: TailLaw) -> OpenFit:
        """Return the same fit with the modes beyond the closed basis as a `law` expects."""
        known = self.layout.prior_sigma_nm
        assert known is not None, "an open basis has a prior"
        sigma = known.clone()
        beyond = torch.tensor(self.layout.nolls) >= law.first_noll
        sigma[beyond] = torch.as_tensor(law.sigma_nm(self.layout.nolls))[beyond]
        layout = replace(self.layout, prior_sigma_nm=sigma)
        return self._with(layout=layout, prior_precision=layout.prior(len(self.images))[1], has_prior=True)

    def reweighed(self, root_weight: torch.Tensor) -> OpenFit:
        """Return the same fit with other square roots of the weights, of the shape of the present ones."""
        return self._with(root_weight=root_weight)


def open_basis(
    closed: ImageFit,
    near: Fit,
    *,
    law: TailLaw | None = None,
    max_iterations: int,
    settle: bool = True,
) -> Opened | None:
    """Fit all modes that the window shows, or return None where it shows no more or no more can be fitted.

    Image and effects are those of a problem of the closed basis, `closed`. The fit starts from one `near` by,
    of some of the modes and effects. The law of the modes beyond is fitted from the `law` of a fit near by,
    or from one of any instrument. Each of the two fits, before and after that of the law, has
    `max_iterations`; the second is left out unless the fit is to `settle`.
    """
    psf = closed.model.psf
    nolls = range(2, last_noll_of(visible_order(psf.settings)) + 1)
    if len(nolls) <= len(psf.nolls):
        return None
    wider = like(psf, psf.settings, nolls)
    model = ImageModel(wider, closed.model.effects.effects)
    sigma = torch.full((len(nolls),), torch.inf, dtype=torch.float64)
    if closed.layout.prior_sigma_nm is not None:
        sigma[: len(psf.nolls)] = closed.layout.prior_sigma_nm
    layout = Layout(wider.nolls, model.effects.parameters, prior_sigma_nm=sigma)
    variance_e2 = closed.root_weight.double() ** -2
    law = law or TailLaw(psf.nolls[-1] + 1)
    problem = OpenFit(model, layout, closed.images, variance_e2, loss=closed.loss).with_law(law)
    found = fitted_from(problem, near.problem.carried(near.x, problem), law, max_iterations)
    return finished(found, max_iterations) if settle and found is not None else found


def fitted_from(problem: OpenFit, start: torch.Tensor, law: TailLaw, max_iterations: int) -> Opened | None:
    """Fit all modes roughly by a `law`, from a `start` (1, parameters); None where numbers are not finite."""
    quick = problem.to(ROUGHLY).hastened()
    rough = solve(quick, start, max_iterations=max_iterations)
    return None if rough.status[0] == INVALID else Opened(quick, rough, law)


def finished(rough: Opened, max_iterations: int) -> Opened | None:
    """Fit the law of the tail where a hastened fit roughly ended, and all modes by it.

    None where numbers are not finite.
    """
    quick, exact, x = rough.problem, rough.problem.exact, rough.x
    # the step from the place of the last derivatives was negligible
    start = x if quick.few_colours is None or quick.known is None else quick.known[0]
    # the law by evidence at a solution with another one
    hessian = exact.normal_equations(x, FIRST)[2][0].numpy()
    precision = quick.prior_precision[0].numpy()
    law = fit_tail_law(rough.law, quick.layout.nolls, x[0].numpy(), hessian, precision)
    problem, quick = (one.with_law(law).to(SETTLED) for one in (exact, quick))
    near = solve(quick, start, max_iterations=max_iterations)
    if near.status[0] == INVALID:
        return None
    final = solve(problem, near.values, max_iterations=FINISHING)
    return None if final.status[0] == INVALID else Opened(problem, final, law)


# Of ln A [nm] and p before anything is known: wide, they only close the law where there is no tail at all.
EXPECTED, WIDTH = np.array([0.0, 1.0]), np.array([3.0, 2.0])
FIRST_SIMPLEX = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])


@dataclass(frozen=True)
class TailLaw:
    """Standard deviation of the modes beyond the closed basis."""

    first_noll: int  # first of these modes
    amplitude_nm: float = 2.0  # A, that of a mode of the first's radial order n₁ [nm RMS]
    slope: float = 1.0  # p

    def sigma_nm(self, nolls: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the standard deviation of modes, (modes,) [nm RMS]."""
        order = np.array([noll_to_nm(int(noll))[0] for noll in nolls], float)
        return self.amplitude_nm * (order / noll_to_nm(self.first_noll)[0]) ** -self.slope


def fit_tail_law(
    law: TailLaw, nolls: Sequence[int], values: np.ndarray, hessian: np.ndarray, precision: np.ndarray
) -> TailLaw:
    """Fit the law by evidence at the optimum found with another one.

    The search begins at `law`, which says what modes it is about; `nolls` are the modes, the first
    parameters. At the optimum `values` (parameters,), half of χ² has the `hessian` (parameters, parameters),
    priors included, and these the `precision` (parameters,).
    """
    tail = np.zeros(len(values), bool)
    tail[: len(nolls)] = np.asarray(nolls) >= law.first_noll
    modes = np.asarray(nolls)[tail[: len(nolls)]]
    cross = _pseudo_inverse(hessian[np.ix_(~tail, ~tail)]) @ hessian[np.ix_(~tail, tail)]
    marginal = hessian[np.ix_(tail, tail)] - hessian[np.ix_(tail, ~tail)] @ cross
    pull = marginal @ values[tail]  # b: priors pull the tail to 0, so the optimum is (S + C⁻¹)⁻¹ b
    curvature = marginal - np.diag(precision[tail])

    def deviance(x: np.ndarray) -> float:
        own = TailLaw(law.first_noll, float(np.exp(x[0])), float(x[1])).sigma_nm(modes)
        factor = cho_factor(curvature + np.diag(own**-2), lower=True)
        spread = 2 * np.log(np.diag(factor[0])).sum() + 2 * np.log(own).sum()
        return float(spread - pull @ cho_solve(factor, pull) + np.sum(((x - EXPECTED) / WIDTH) ** 2))

    start = np.array([np.log(law.amplitude_nm), law.slope])
    tolerances = {"xatol": 0.02, "fatol": 0.02, "initial_simplex": start + FIRST_SIMPLEX}
    found = minimize(deviance, start, method="Nelder-Mead", options=tolerances).x
    return TailLaw(law.first_noll, float(np.exp(found[0])), float(found[1]))


def _pseudo_inverse(matrix: np.ndarray) -> np.ndarray:
    """Of normal equations of parameters in different units, of which some may not be determined."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    per = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    return np.linalg.pinv(matrix * np.outer(per, per), rcond=1e-12, hermitian=True) * np.outer(per, per)


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
    search = _Search(problem.to(ROUGHLY).hastened(), most, np.random.default_rng(SEED))
    begun = task.problem(problem.model.effects.effects)  # the closed basis may hold some of them
    starts = [begun.carried(x, problem) for x in task.starts(begun)]
    best = search.best_from(starts, opened.x)
    if best is None or _objective(best) >= opened.objective:
        return opened
    # beside the search, the derivatives known are of other places
    found = Opened(search.problem._with(known=None), best, opened.law)
    return finished(found, task.options.max_iterations) or opened


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
