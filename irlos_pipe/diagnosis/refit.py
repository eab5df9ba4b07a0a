"""Non-linear fits of the families that a score proposes, and their order."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from irlos_pipe.diagnosis.fitting import Fitted, Fitter
from irlos_pipe.diagnosis.null_model import FAR_OFF, Excess, Optimum
from irlos_pipe.diagnosis.scores import Score
from irlos_pipe.effects import Conditions, Effect, FixedEffect, in_other_forms
from irlos_pipe.effects.base import label_of
from irlos_pipe.numerics.parallel import ordered_map

PROPOSALS = 8  # families that are fitted at most
HOPELESS = 0.1  # part of the fall of χ² by a name that leaves nothing; what promises less needs no fit
NOTHING_LEFT = 5.0  # significance of the excess below which nothing is left to explain
ENOUGH = 3  # fits of the most promising, whose best shows whether a single name may explain it
SIDE_BY_SIDE = 2  # fits at once, after which others may prove hopeless
PER_PARAMETER = 8.0  # fall of χ² that a parameter has to earn
EXPLAINS_AS_MUCH = 0.97  # part of the best's fall of χ² from which another family is its rival
CLEARLY_LESS = 25.0  # deficit of calibrated χ² below which another family is a rival whatever it explains


@dataclass(frozen=True, eq=False)
class Refit:
    """A family fitted jointly with the effects that the model has."""

    score: Score  # from which the fit started
    origin: Optimum  # without it
    fitted: Fitted  # with it
    label: str = ""  # of the effect in the model; the last of its kind unless said
    sigma: float | None = None  # its significance, where it does not follow from the image alone

    def __post_init__(self):
        kinds = [effect.name for effect in self.origin.fitted.effects]
        object.__setattr__(self, "label", self.label or label_of(self.name, kinds.count(self.name)))

    @property
    def name(self) -> str:
        return self.score.name

    @property
    def gain(self) -> float:
        return self.origin.fitted.chi2 - self.fitted.chi2

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
        """Significance in Gaussian σ of its change of the image, against noise or the scatter of frames."""
        if self.sigma is not None:
            return self.sigma
        return self.origin.significance_of_change(self.fitted, self.parameters, self.score.trials)

    def deficit(self, other: "Refit") -> float:
        """By how much less χ² falls by another one, over what the scatter of frames makes of it."""
        return (other.fitted.chi2 - self.fitted.chi2) / self.score.inflation

    @property
    def effect(self) -> Effect:
        return self.fitted.effect(self.label)

    @property
    def base(self) -> Effect:
        return self.effect.base

    @property
    def values(self) -> np.ndarray:
        return self.fitted.values_of(self.label)

    def wider_forms(self, conditions: Conditions) -> list[FixedEffect]:
        """Wider forms of the effect, where it is; what acts in some moments alone has none."""
        if self.base.acts_in is not None:
            return []
        return in_other_forms(self.name, conditions, self.values, wider=True)

    @property
    def implausible(self) -> list[str]:
        """Parameters at a bound or outside the plausible range."""
        return self.base.unusual(self.values)


def refits(
    fitter: Fitter,
    origin: Optimum,
    scores: Sequence[Score],
    report: Callable[[int], None] = lambda count: None,
) -> list[Refit]:
    """Fit the most promising families by calibrated gain, the first by itself, and return the best first.

    `origin` is the model without them; `report` is called with the number of finished fits. Where the best
    leaves nothing to explain, those that promise too little of its fall of χ² are left out.
    """
    promising = [score for score in scores if score.testable and score.gain > 0]
    promising = sorted(promising, key=lambda one: -one.gain / one.inflation)[:PROPOSALS]

    def fitted(score: Score) -> Refit:
        effects = [*origin.fitted.continued(), score.whole()]
        return Refit(score, origin, fitter.explored(effects, origin.fitted))

    found: list[Refit] = []
    for begin in (0, *range(1, len(promising), SIDE_BY_SIDE)):
        some = promising[begin : begin + (SIDE_BY_SIDE if begin else 1)]
        best = _best(found) if found else None
        if best and len(found) >= ENOUGH and best.excess.chi2_nu > FAR_OFF:
            break  # no single name will do
        explains_all = best and origin.excess.significance > NOTHING_LEFT > best.excess.significance
        enough = HOPELESS * best.gain if best and explains_all else -np.inf
        found = _joined(fitter, found, ordered_map(fitted, [one for one in some if not one.gain < enough]))
        report(len(some))
    # wider forms from where the effect is: a second image may be out of focus
    pairs = [(one, form) for one in _leaders(found) for form in one.wider_forms(fitter.views[0].conditions)]
    found = _joined(fitter, found, ordered_map(lambda pair: _as_effect(fitter, *pair), pairs))
    # rivals of the best converge, as any may be chosen
    rivals = [one for one in _leaders(found) if one.fitted.explored]
    finished = ordered_map(partial(_finished, fitter), rivals)
    found = _joined(fitter, [one for one in found if one not in rivals], finished)
    return sorted(found, key=lambda one: -one.merit)


def _joined(fitter: Fitter, found: Sequence[Refit], new: Sequence[Refit]) -> list[Refit]:
    """Both without failed fits; the best of all continues until it converges."""
    joined = [one for one in (*found, *new) if np.isfinite(one.fitted.chi2)]
    while joined and (best := _best(joined)).fitted.explored:
        joined[joined.index(best)] = _finished(fitter, best)
    return joined


def _best(found: Sequence[Refit]) -> Refit:
    return max(found, key=lambda one: one.merit)


def _finished(fitter: Fitter, one: Refit) -> Refit:
    return replace(one, fitted=fitter.finished(one.fitted))


def _leaders(found: Sequence[Refit]) -> list[Refit]:
    """The best and its rivals, with which χ² falls about as far."""
    if not found:
        return []
    best, enough = _best(found), EXPLAINS_AS_MUCH * _best(found).gain
    return [one for one in found if best.deficit(one) < CLEARLY_LESS or one.gain > enough]


def _as_effect(fitter: Fitter, one: Refit, effect: FixedEffect) -> Refit:
    """A fit with another effect in the place of what was fitted, from where all else is."""
    others = one.fitted.continued_by_label()
    del others[one.label]
    score = replace(one.score, candidate=effect, sizes=effect.values, besides=(), elsewhere=())
    return Refit(score, one.origin, fitter.explored([*others.values(), effect], one.fitted))
