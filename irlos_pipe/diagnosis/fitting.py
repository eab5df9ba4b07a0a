"""Fits of one wavefront and one set of effects to the mean training images of one or several recordings.

Tip, tilt, flux and background are those of each recording. Recordings of other moments, of another star or
night, have effects of their own, and a wavefront that differs from the common one by a drift: small changes
of every mode with a Gaussian prior. The parameter vector is that of the first recording with the drifts and
the other recordings' own numbers between the effects and its flux and background.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.diagnosis.cube import Stack, Stacks
from irlos_pipe.diagnosis.records import DRIFT_NM
from irlos_pipe.diagnosis.view import View
from irlos_pipe.effects import Effect, FixedEffect
from irlos_pipe.effects.effect_set import EffectSet
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import NcpaPrior
from irlos_pipe.estimate.image_fit import ImageFit, JoinedFit, Layout
from irlos_pipe.estimate.starts import start_tilts_nm, twin_of
from irlos_pipe.numerics.solver import CHI2_TOLERANCE, INVALID, CheapGradientProblem, Solution, solve

PRIOR_SCALE = 3.0  # width of the prior over the law of the NCPAs
MAX_ITERATIONS = 60
SAME_IMAGE = 1e-6  # χ² between two images that differ by rounding
EXPLORING = 30  # iterations after which it is known whether a fit is promising
ROUGHLY = 0.1  # fall of χ² ahead, in units of χ²/ν where the model misfits, at which that is known


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
            unknown = torch.full((1, problem.size, problem.size), torch.nan, dtype=torch.float64)
            no, chi2 = torch.zeros(1, dtype=torch.int64), float("inf")
            solution = Solution(start, unknown, [INVALID], no, torch.full_like(start[:, 0], chi2))
        return Fitted(problem, solution, chi2, self.views)


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


@dataclass(frozen=True)
class Fitted:
    """A model as a fit left it."""

    problem: JointFit
    solution: Solution
    chi2: float  # of the mean training images
    views: Sequence[View]  # of the recordings
    complete: bool = False  # whether its covariance holds all errors of the mean images, speckles' as well

    @property
    def x(self) -> torch.Tensor:
        """All parameters, (1, parameters)."""
        return self.solution.values

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects of the model, in the order of the light path."""
        return self.problem.effects.effects

    def moved(self, by: torch.Tensor) -> Fitted:
        """The model with other parameters, nothing fitted."""
        return Fitted(self.problem, replace(self.solution, values=self.x + by), self.chi2, self.views)

    def with_wavefront(self, zernike_nm: Mapping[int, float]) -> Fitted:
        """The model with another wavefront, Noll index to nm RMS, where it is known; it points as it did."""
        x = self.x.clone()
        for place, noll in enumerate(self.problem.layout.nolls):
            if noll not in TIP_TILT:
                x[0, place] = zernike_nm.get(noll, 0.0)
        return replace(self, solution=replace(self.solution, values=x))

    @property
    def modes_nm(self) -> np.ndarray:
        """Zernike coefficients, (modes,)."""
        return self.x[0, self.problem.layout.modes].numpy()

    @property
    def effect_values(self) -> torch.Tensor:
        """Parameters of all effects, (parameters,)."""
        return self.x[0, self.problem.layout.effect_values]

    @property
    def recordings(self) -> list[tuple[ImageFit, torch.Tensor]]:
        """Problem and parameters (1, its parameters) of every recording by itself."""
        return [(part, self.problem.part(self.x, number)) for number, part in enumerate(self.problem.parts)]

    @cached_property
    def image_e(self) -> torch.Tensor:
        """Predicted mean images, (pixels,); those that came with the derivatives, where these are known."""
        return self.linearised[0] if "linearised" in vars(self) else self.problem.predict(self.x)

    @cached_property
    def linearised(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean images (pixels,) and derivatives (parameters, pixels), which many ask for."""
        return self.problem.predict_and_jacobian(self.x)

    @property
    def penalty(self) -> float:
        """What the priors add to χ²."""
        offset = self.x - self.problem.prior_mean
        return float((self.problem.prior_precision * offset**2).sum())

    @property
    def converged(self) -> bool:
        """Whether the solver says so."""
        return bool(self.solution.converged[0])

    def effect(self, label: str) -> Effect:
        return self.effects[self.problem.effects.labels.index(label)]

    def values_of(self, label: str) -> np.ndarray:
        """All parameters of the effect, fixed ones included."""
        free = self.problem.effects.split(self.effect_values)[label]
        return self.effect(label).all_values(free).numpy()

    def columns_of(self, label: str) -> list[int]:
        """Positions of the effect's free parameters in the whole parameter vector."""
        begin = self.problem.layout.effect_values.start
        return [begin + index for index in self.problem.effects.columns_of(label)]

    def continued(self) -> list[Effect]:
        """The effects with the same freedom, to start from where they are now."""
        return [*self.continued_by_label().values()]

    def continued_by_label(self) -> dict[str, Effect]:
        """The same by label, to leave one out or to put another in its place."""
        effects = self.problem.effects
        rows = zip(effects.labels, self.effects, effects.pieces(self.effect_values), strict=True)
        return {label: begun_at(effect, piece) for label, effect, piece in rows}


def begun_at(effect: Effect, values: Sequence[float] | np.ndarray) -> Effect:
    """The same effect with the same freedom, from other `values` of its free parameters."""
    if not effect.parameters:
        return effect
    free = [parameter.name for parameter in effect.parameters]
    return FixedEffect(effect.base, effect.all_values(values).numpy(), free)


OWN = 4  # tip, tilt, flux and background of each recording
POINTING = 2  # modes that belong to each recording, tip and tilt


class JointFit(CheapGradientProblem, JoinedFit):
    """Least-squares problem for the solver; one member.

    Of the `parts`, one per recording, all have the same modes, Noll 2 and 3 first, and those effects that act
    in them; `effects` are all, by default those of the first recording. Unless `moments` says the moment of
    each recording, it is the same. `drift_nm` is the prior σ of the change of every mode from the common
    wavefront to that of a moment, of no use with one moment. The fit is done where the fall of χ² still ahead
    is below `tolerance`, in units of χ²/ν where the model misfits.
    """

    def __init__(
        self,
        parts: Sequence[ImageFit],
        effects: EffectSet | None = None,
        moments: Sequence[int] = (),
        drift_nm: float = DRIFT_NM,
        tolerance: float = CHI2_TOLERANCE,
    ):
        self.model = parts[0].model
        self.effects = self.model.effects if effects is None else effects
        self.moments = tuple(moments) or (0,) * len(parts)
        layout = replace(parts[0].layout, effects=self.effects.parameters)
        shared, modes = layout.size - 2, len(layout.nolls)
        drifting = sorted({*self.moments}) if len({*self.moments}) > 1 else []
        starts = (shared + number * (modes - POINTING) for number in range(len(drifting)))
        self.drifts = {
            moment: list(range(begin, begin + modes - POINTING))
            for moment, begin in zip(drifting, starts, strict=True)
        }
        begin_own = shared + len(drifting) * (modes - POINTING)
        last = begin_own + OWN * (len(parts) - 1)
        columns = []
        for number, moment in enumerate(self.moments):
            begin = begin_own + OWN * (number - 1)
            tip, tilt, flux, background = range(begin, begin + OWN) if number else (0, 1, last, last + 1)
            acting = [modes + column for column in self.effects.columns_in(moment)]
            columns.append([tip, tilt, *range(POINTING, modes), *acting, flux, background])
        changes = [dict(enumerate(self.drifts.get(moment, ()), POINTING)) for moment in self.moments]
        sigma = {column: drift_nm for columns in self.drifts.values() for column in columns}
        super().__init__(parts, columns, changes, sigma, tolerance)
        self.layout = layout
        ends = torch.tensor([0, *(part.images.shape[-1] for part in parts)]).cumsum(0).tolist()
        self.pixels = [slice(a, b) for a, b in pairwise(ends)]

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns, the same in all recordings."""
        return self.model.psf.settings.window

    def own_of(self, number: int) -> list[int]:
        """Columns of tip, tilt, flux and background of recording `number`."""
        return [self.own[number][i] for i in (0, 1, -2, -1)]

    @property
    def tail(self) -> int:
        """Number of parameters behind the effects."""
        return self.size - self.layout.effect_values.stop

    # -- images ------------------------------------------------------------------------------

    def predict(self, x: torch.Tensor) -> torch.Tensor:
        """Mean images of all recordings [e-], one after the other, (pixels,)."""
        pairs = enumerate(self.parts)
        return torch.cat([part.predict(self.part(x, number))[0].cpu() for number, part in pairs])

    def predict_and_jacobian(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean images (pixels,) and derivatives (parameters, pixels)."""
        images, jacobian = [], torch.zeros(self.size, self.pixels[-1].stop, dtype=torch.float64)
        for number, part in enumerate(self.parts):
            image, own = part.predict_and_jacobian(self.part(x, number))
            images.append(image[0].cpu())
            jacobian[self.columns[number], self.pixels[number]] = own[0].cpu().double()[self.rows[number]]
        return torch.cat(images), jacobian
