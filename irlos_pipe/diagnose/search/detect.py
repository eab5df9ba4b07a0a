"""Which families of effects the residual calls for: score tests at the optimum of the current model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy import special, stats

from irlos_pipe.diagnose.optimum import Optimum
from irlos_pipe.diagnose.search.bundle import Bundle
from irlos_pipe.diagnose.search.companion_search import around, brightest_companions
from irlos_pipe.diagnose.search.families import Family
from irlos_pipe.effects import Effect, FixedEffect
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.numerics.parallel import ordered_map

ABSORBED = 0.003  # part of a derivative's power below which the fitted parameters imitate the effect
NOTHING = 1e-9  # of the largest derivative: a parameter without meaning here, a colour of a single wavelength
MOST_OF_FRAMES = 0.3  # directions of a test over the number of frames
BUNDLED = 16  # candidates in the pupil
LINEAR = 0.5  # of the prior's σ: how far from nothing a fit begins at most
FURTHER_STARTS, FAR_APART = 2, 0.2  # of a fit; part of the range of a place or direction


@dataclass(frozen=True, eq=False)
class Score:
    """What one candidate would do at the optimum without it.

    Attributes
    ----------
    candidate : Effect
        Its free parameters at their null values.
    sizes : ndarray, (parameters,)
        Linear estimate of the free parameters, within their bounds.
    gain : float
        Predicted fall of χ².
    inflation : float
        Fall of χ² per parameter that the scatter of frames leads to expect without the effect.
    survival : float
        Part of the derivative's power that the fitted parameters cannot imitate, of the best parameter.
    significance : float
        In Gaussian σ, candidates of the family counted as trials.
    smallest : ndarray, (parameters,)
        Size of each parameter whose expected gain is one times the inflation, median over the candidates.
    usable : tuple of str
        Parameters that these data determine.
    trials : int
        Candidates of the family.
    besides : tuple of Score
        Best candidates with other parameters of the same effect.
    elsewhere : tuple of Score
        Next best candidates far from this one, where a fit may begin as well.
    """

    candidate: Effect
    sizes: np.ndarray
    gain: float
    inflation: float
    survival: float
    significance: float
    smallest: np.ndarray
    usable: tuple[str, ...] = ()
    trials: int = 1
    besides: tuple[Score, ...] = ()
    elsewhere: tuple[Score, ...] = ()

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.candidate.name

    @property
    def testable(self) -> bool:
        """Whether these data can show the effect."""
        return self.survival > ABSORBED

    def start(self) -> FixedEffect:
        """The whole effect, free but for what these data do not determine, at the linear estimate.

        A phase of a radian is no longer linear: whatever has a prior starts well within it.
        """
        null = np.array(self.candidate.null_values)
        reach = LINEAR * np.array([p.prior_sigma for p in self.candidate.parameters])
        return self._begun_at(np.clip(self.sizes, null - reach, null + reach))

    def anew(self) -> FixedEffect:
        """The same without the estimate."""
        return self._begun_at([p.start for p in self.candidate.parameters])

    def _begun_at(self, sizes: Sequence[float]) -> FixedEffect:
        base, values = self.candidate.base, self.candidate.all_values(sizes).numpy()
        unseen = {p.name for p in self.candidate.parameters} - {*self.usable}
        return FixedEffect(base, values, [p.name for p in base.parameters if p.name not in unseen])


def scores(optimum: Optimum, families: Sequence[Family]) -> list[Score]:
    """Best candidate of every family, the most significant family first."""
    found = [score_family(optimum, family) for family in families]
    return sorted(found, key=lambda one: -one.significance)


def score_family(optimum: Optimum, family: Family) -> Score:
    """Best candidate of one family; its other candidates count as trials."""
    settings = optimum.fitted.problem.model.psf.settings
    tried = [
        candidate
        for effect in family.variants
        for candidate in effect.candidates(settings.window, settings.pixel_scale_mas)
    ]
    trials = len(tried) * family.places
    if family.name == Companion.name:
        tried = [*brightest_companions(optimum, tried), *around(tried[0].base)]
    pieces = ordered_map(partial(_scored, optimum, trials), _bundles(tried))
    found = [score for piece in pieces for score in piece]
    kinds = {one.usable: _typical([o for o in found if o.usable == one.usable]) for one in found}
    best = max(kinds.values(), key=lambda one: one.gain)
    besides = tuple(one for one in kinds.values() if one is not best and one.usable)
    return replace(best, besides=besides, elsewhere=_elsewhere(best, found))


def _typical(alike: Sequence[Score]) -> Score:
    """The best of candidates with the same parameters, with sizes that are typical of them all."""
    smallest = np.median([one.smallest for one in alike], axis=0)
    return replace(max(alike, key=lambda one: one.gain), smallest=smallest)


def _elsewhere(best: Score, found: Sequence[Score]) -> tuple[Score, ...]:
    """The best candidates that differ from `best` and from each other by much of the range tried."""
    alike = [one for one in found if one.usable == best.usable and isinstance(one.candidate, FixedEffect)]
    if len(alike) < 2 or not isinstance(best.candidate, FixedEffect):
        return ()
    tried = np.array([one.candidate.values for one in alike])
    unit = np.ptp(tried, axis=0)
    places = (tried - best.candidate.values) / np.where(unit > 0, unit, 1.0)
    chosen: list[int] = []
    for index in np.argsort([-one.gain for one in alike]):
        distances = np.abs(places[index] - [np.zeros(len(unit)), *places[chosen]]).max(axis=1)
        if len(chosen) < FURTHER_STARTS and distances.min() > FAR_APART and alike[index].gain > 0:
            chosen.append(int(index))
    return tuple(alike[index] for index in chosen)


def whitened_shapes(optimum: Optimum, candidates: Sequence[Effect]) -> list[torch.Tensor]:
    """Derivatives of the mean images with respect to each candidate's parameters at null, (pixels, m) each.

    Several candidates must be of the pupil.
    """
    views = optimum.fitted.views
    columns = [
        _derivatives(optimum, number, _together([view.seen(one, views[0]) for one in candidates]))
        for number, view in enumerate(views)
    ]
    shapes = (torch.cat(columns, dim=1) * optimum.root).mT
    return list(shapes.split([len(one.parameters) for one in candidates], dim=1))


def _together(candidates: Sequence[Effect]) -> Effect:
    return candidates[0] if len(candidates) == 1 else Bundle(candidates)


def _bundles(candidates: Sequence[Effect]) -> list[Sequence[Effect]]:
    """Candidates of one family whose derivatives are computed together."""
    size = BUNDLED if candidates[0].plane == "pupil" else 1
    return [candidates[i : i + size] for i in range(0, len(candidates), size)]


def _derivatives(optimum: Optimum, number: int, candidate: Effect) -> torch.Tensor:
    """Of the mean image of one recording with respect to a candidate's parameters at null, (m, pixels)."""
    problem = optimum.fitted.problem
    part, x = problem.parts[number], problem.part(optimum.fitted.x, number)
    model, layout = part.model, part.layout
    sampling = candidate.plane == "sampling"
    own = model.effects.held(x[0, layout.effect_values]).effects if sampling else optimum.frozen[number]
    whole = ImageModel(model.psf, [*own, candidate])
    null = torch.tensor(candidate.null_values, dtype=torch.float64)
    modal = candidate.plane not in ("pupil", "otf")  # with nothing else there is nothing to propagate
    at = x[:, layout.modes], x[:, -2], x[:, -1], null
    columns = whole.predict_and_jacobian(*at, modal=modal)[1][0].cpu().double().flatten(1)
    return columns[len(columns) - 2 - len(null) : -2]


def _scored(optimum: Optimum, trials: int, candidates: Sequence[Effect]) -> list[Score]:
    pairs = zip(candidates, whitened_shapes(optimum, candidates), strict=True)
    return [_score(optimum, trials, candidate, shapes) for candidate, shapes in pairs]


def _score(optimum: Optimum, trials: int, candidate: Effect, shapes: torch.Tensor) -> Score:
    power, left = (shapes**2).sum(0), torch.diagonal(optimum.norm2(shapes))
    survival = left / power.clamp_min(1e-300)
    usable = (power > NOTHING * power.max()) & (survival > ABSORBED)
    if not usable.any():
        nothing = np.full(len(power), np.inf)
        null = np.array(candidate.null_values, float)
        return Score(candidate, null, 0.0, 1.0, float(survival.max()), 0.0, nothing, trials=trials)
    sizes, gain, inflation, significance = _test(optimum, candidate, shapes, usable, trials)
    smallest = torch.where(usable, (inflation / left.clamp_min(1e-300)).sqrt(), torch.inf).numpy()
    names = tuple(p.name for p, use in zip(candidate.parameters, usable.tolist(), strict=True) if use)
    best = float(survival[usable].max())
    return Score(candidate, sizes, gain, inflation, best, significance, smallest, names, trials)


def _test(optimum: Optimum, candidate, shapes: torch.Tensor, usable: torch.Tensor, trials: int):
    """Linear sizes, fall of χ², its inflation and its significance."""
    sigma = torch.tensor([p.prior_sigma for p in candidate.parameters], dtype=torch.float64)[usable]
    used = shapes[:, usable]
    normal = optimum.norm2(used) + torch.diag(sigma**-2)
    meeting = optimum.meeting(used)
    null = torch.tensor(candidate.null_values, dtype=torch.float64)
    change = torch.zeros_like(null)
    change[usable] = torch.linalg.solve(normal, meeting)
    sizes = _within(candidate, null + change)
    step = (sizes - null)[usable]
    gain = float(2 * step @ meeting - step @ normal @ step)
    inflation, significance = significance_of(optimum, used, normal, meeting, trials)
    return sizes.numpy(), gain, inflation, significance if gain > 0 else 0.0


def significance_of(optimum: Optimum, shapes, normal, meeting, trials: int) -> tuple[float, float]:
    """Inflation, and Hotelling's T² of the projections over the frames in Gaussian σ.

    Frames allow no test in more directions than a part of their number: the leading ones of the
    normal matrix are taken, into which the family's power falls. Directions that the prior holds are
    left out.
    """
    stack = optimum.stack
    values, vectors = torch.linalg.eigh(normal)
    measured = ((vectors.mT @ optimum.norm2(shapes)) * vectors.mT).sum(1) > 0.5 * values
    if not measured.any():
        return 1.0, 0.0
    axes = (vectors / values.sqrt())[:, measured]  # the shapes along them are orthonormal
    if not stack.photon_limited:
        axes = axes[:, -max(1, int(MOST_OF_FRAMES * stack.independent)) :]
    along, covariance = axes.mT @ meeting, stack.covariance_of(optimum.project(shapes @ axes))
    inflation = float(covariance.diagonal().mean())
    if stack.photon_limited:
        return 1.0, gaussian_sigma(float(along @ along), len(along), np.inf, trials)
    hotelling = float(along @ torch.linalg.solve(covariance, along))
    return inflation, gaussian_sigma(hotelling, len(along), stack.independent, trials)


def gaussian_sigma(hotelling: float, directions: int, frames: float, trials: int = 1) -> float:
    """Hotelling's T² of a mean over frames as the σ of a normal deviate of the same tail probability.

    With infinitely many `frames` it is χ².
    """
    if np.isinf(frames):
        tail = stats.chi2.logsf(hotelling, directions)
        # Beyond the range of logsf: its leading terms.
        tail = tail if np.isfinite(tail) else -hotelling / 2 + (directions / 2 - 1) * np.log(hotelling / 2)
    else:
        freedom = max(frames - directions, 1.0)
        tail = _log_tail_of_f(hotelling * freedom / (directions * (frames - 1)), directions, freedom)
    return float(max(-special.ndtri_exp(min(tail + np.log(trials), np.log(0.5))), 0.0))


def _log_tail_of_f(value: float, above: float, below: float) -> float:
    """``ln P(F > value)`` for any number of degrees of freedom.

    F is a ratio of which ``x = below / (below + above F)`` follows a beta law; far out its tail is the
    leading term of the incomplete beta function.
    """
    tail = stats.f.logsf(value, above, below)
    if np.isfinite(tail):
        return float(tail)
    x, (a, b) = below / (below + above * value), (below / 2, above / 2)
    return float(a * np.log(x) + (b - 1) * np.log1p(-x) - np.log(a) - special.betaln(a, b))


def _within(candidate: Effect, values: torch.Tensor) -> torch.Tensor:
    limits = torch.tensor([[p.lower, p.upper] for p in candidate.parameters], dtype=torch.float64)
    return values.clamp(limits[:, 0], limits[:, 1])
