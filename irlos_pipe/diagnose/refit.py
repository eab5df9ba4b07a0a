"""Non-linear fits of the families that a score proposes, and their order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..effects import Effect, Pinned
from ..effects.seeing_halo import ScaledHalo
from .detect import Score, gaussian_sigma
from .fitting import Fitted, Fitter, most_plausible
from .optimum import Excess, Optimum

PROPOSALS = 8
HOPELESS = 0.1  # of the fall of χ² by a name that leaves nothing to explain: others need no fit
NOTHING_LEFT = 5.0  # significance of the excess
FAR = 10.0  # χ²/ν from which the model may be at a false minimum
RETRIED = 2  # of the most promising families, if none leaves nothing
EXPLORING = 15  # iterations, after which only the best goes on
PER_PARAMETER = 8.0  # of χ², that a parameter has to earn
FULL_HALO = 0.1  # of the expected residual, from which the halo's shape is fitted as well


@dataclass(frozen=True, eq=False)
class Refit:
    """A family fitted beside the effects that the model has.

    Attributes
    ----------
    score : Score
        From which the fit started.
    origin : Optimum
        Without it.
    fitted : Fitted
        With it.
    """

    score: Score
    origin: Optimum
    fitted: Fitted

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.score.name

    @property
    def gain(self) -> float:
        """Fall of χ²."""
        return self.origin.fitted.chi2 - self.fitted.chi2

    @property
    def explains_all(self) -> bool:
        """Whether nothing significant is left of the excess, although there was some."""
        return self.origin.excess.significance > NOTHING_LEFT > self.excess.significance

    @property
    def parameters(self) -> int:
        """Number of free parameters it adds."""
        return len(self.fitted.effect_values) - len(self.origin.fitted.effect_values)

    @property
    def merit(self) -> float:
        """What the proposals are ranked by: fall of χ² after a price per parameter."""
        return self.gain - PER_PARAMETER * self.score.inflation * self.parameters

    @cached_property
    def optimum(self) -> Optimum:
        """Residual with the effect in the model."""
        return Optimum(self.origin.stack, self.fitted)

    @cached_property
    def excess(self) -> Excess:
        """χ² beyond noise that is left."""
        return self.optimum.excess

    @cached_property
    def significance(self) -> float:
        """Of the change that it makes of the image, against noise or the scatter of frames, in Gaussian σ."""
        origin, stack = self.origin, self.origin.stack
        if stack.photon_limited:
            return gaussian_sigma(max(self.gain, 0.0), self.parameters, np.inf, self.score.trials)
        change = ((self.fitted.image_e - origin.fitted.image_e) * origin.root)[:, None]
        variance = stack.covariance_of(origin.project(change))[0, 0]
        hotelling = float(origin.meeting(change)[0] ** 2 / variance.clamp_min(1e-300))
        return gaussian_sigma(hotelling, self.parameters, stack.independent, self.score.trials)

    @property
    def effect(self) -> Effect | Pinned:
        """The effect as fitted."""
        return next(one for one in self.fitted.effects if one.name == self.name)

    @property
    def bare(self) -> Effect:
        """The effect itself."""
        return self.effect.bare

    @property
    def values(self) -> np.ndarray:
        """All its parameters."""
        return self.effect.all_values(self.fitted.values_of(self.name)).numpy()

    @property
    def public(self) -> dict:
        """Its parameters under public names."""
        return self.bare.describe(self.values)

    @property
    def implausible(self) -> list[str]:
        """Free parameters at a bound or outside the plausible range."""
        pairs = zip(self.bare.parameters, self.values, strict=True)
        return [p.name for p, value in pairs if not _plausible(p, value)]


def _plausible(parameter, value: float) -> bool:
    low, high = parameter.plausible
    at_bound = (
        parameter.null is not None and parameter.null != value and value in (parameter.lower, parameter.upper)
    )
    return low <= value <= high and not at_bound


def refits(
    fitter: Fitter,
    origin: Optimum,
    scores: Sequence[Score],
    report: Callable[[int], None] = lambda count: None,
) -> list[Refit]:
    """The most promising families fitted in turn, the best first."""
    found: list[Refit] = []
    for score in proposals(scores):
        report(1)
        if any(one.explains_all and score.gain < HOPELESS * one.gain for one in found):
            continue
        near = _explored(fitter, origin, _start(score), origin.fitted)
        found.append(_finished(fitter, Refit(score, origin, near), found))
    if origin.excess.chi2_nu > FAR:
        found = _once_more(fitter, found, lambda one: True, _from_zero)
    found = _once_more(fitter, found, lambda one: bool(one.score.elsewhere), _from_elsewhere)
    return sorted(found, key=lambda one: -one.merit)


def _explored(fitter: Fitter, origin: Optimum, effect: Pinned, near: Fitted | None) -> Fitted:
    """A fit that goes as far as tells whether it is promising."""
    return fitter.fit([*origin.fitted.continued(), effect], near, EXPLORING)


def _finished(fitter: Fitter, one: Refit, rivals: Sequence[Refit]) -> Refit:
    """The same until it converges, if it is better than its rivals."""
    if any(one.merit < other.merit for other in rivals):
        return one
    return replace(one, fitted=fitter.finished(one.fitted))


def _once_more(
    fitter: Fitter,
    found: Sequence[Refit],
    allowed: Callable[[Refit], bool],
    starts: Callable[[Fitter, Refit], list[Fitted]],
) -> list[Refit]:
    """The most promising of the `allowed` families begun again, unless one leaves nothing to explain."""
    if any(one.excess.significance < NOTHING_LEFT for one in found):
        return list(found)
    result = list(found)
    for one in sorted(filter(allowed, found), key=lambda one: -one.merit)[:RETRIED]:
        better = replace(one, fitted=most_plausible([one.fitted, *starts(fitter, one)]))
        result[result.index(one)] = _finished(fitter, better, [other for other in result if other is not one])
    return result


def _from_zero(fitter: Fitter, one: Refit) -> list[Fitted]:
    """Without the wavefront of the model before, which may be a false minimum.

    A model that misses something large can fit it with a wavefront far from the true one.
    """
    return [_explored(fitter, one.origin, _start(one.score), None)]


def _from_elsewhere(fitter: Fitter, one: Refit) -> list[Fitted]:
    """From the next best places or directions: the best of a linear estimate may be a wrong one."""
    return [_explored(fitter, one.origin, other.start(), one.origin.fitted) for other in one.score.elsewhere]


def proposals(scores: Sequence[Score]) -> list[Score]:
    """Families that promise most, by calibrated gain."""
    promising = [score for score in scores if score.testable and score.gain > 0]
    return sorted(promising, key=lambda one: -one.gain / one.inflation)[:PROPOSALS]


def _start(score: Score) -> Pinned:
    """The effect at its linear estimate; the halo with its shape free, if there is enough of it."""
    start = score.start()
    if not isinstance(start.effect, ScaledHalo) or score.sizes[0] < FULL_HALO:
        return start
    halo = start.effect.halo
    return Pinned(halo, [p.start for p in halo.parameters], [p.name for p in halo.parameters])
