"""Effects that fit as well on their opposite side, and facts that further fits should leave free.

A stop that is moved one way and one that is moved the other way make the same image to first order, but for
the even part of the wavefront. Odd modes imitate the difference: behind a strong AO residual both sides may
fit.

None of the facts that stay free is named. A name needs evidence; an estimate needs none. A calibration that
takes for exact what was only declared errs by all that this is wrong, up to the five standard errors from
which an effect is named. To free it costs the variance that it adds to all else, and pays where it is off by
more than some √2 standard errors (Akaike 1974, IEEE Trans. Autom. Control 19, 716). Where a diagnosis had to
free all facts at once, those stay free in the model that it leaves, from where they fit best: a displaced
stop is begun on every side of the pupil, as the image has a kink where it is not displaced. Facts of a
design, such as square pixels, are left as they are: what the model of the AO residual misses imitates them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.diagnosis.fitted import POINTING, Fitted, begun_at
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import OppositeSide
from irlos_pipe.diagnosis.starts import all_around, direction_of, on_other_sides, other_sides
from irlos_pipe.diagnosis.tolerant import everyday
from irlos_pipe.diagnosis.without import needless
from irlos_pipe.effects import Effect, FixedEffect


def opposite_side(fitter: Fitter, final: Optimum, label: str, sure: float) -> OppositeSide | None:
    """The `final` fit with an effect of the pupil on its opposite side, unless the data exclude that.

    The data exclude it from a significance of `sure` on, in Gaussian σ. None as well for effects without a
    direction in the pupil, and where the fit leads back.
    """
    fitted = final.fitted
    if label not in fitted.problem.effects.labels or fitted.effect(label).plane != "pupil":
        return None
    angle = direction_of(fitted, label)
    if angle is None:
        return None
    own = fitter.of(final.stack, fitted.views)
    for side in other_sides(fitted, label):
        other = _from(own, fitted, label, side)
        rise = own.rise_between(fitted, other)
        if _is_opposite(fitted, other, fitted.columns_of(label)[angle]) and rise < sure**2:
            base, values = other.effect(label).base, other.values_of(label)
            public = base.describe(values)
            change_nm = float(np.linalg.norm((other.modes_nm - fitted.modes_nm)[POINTING:]))
            return OppositeSide(public, base.phrase(public), rise, change_nm)
    return None


def _from(fitter: Fitter, fitted: Fitted, label: str, values: np.ndarray) -> Fitted:
    """The fit in which an effect begins with other `values`."""
    effects = fitted.continued_by_label()
    effects[label] = begun_at(effects[label], values)
    return fitter.finished(fitter.explored([*effects.values()], fitted))


def _is_opposite(fitted: Fitted, other: Fitted, column: int) -> bool:
    """Whether the direction in a `column` points more away from where it was than towards it."""
    turned = float(other.x[0, column] - fitted.x[0, column])
    return bool(np.isfinite(other.chi2) and np.cos(turned) < 0)


WORTH = 1.5  # standard errors by which a fact must be off to be worth its freedom, some √2


def open_facts(fitter: Fitter, final: Optimum, known: Sequence[str]) -> list[FixedEffect]:
    """Return those facts, of the `final` model or lacking in it, that are off by more than `WORTH`.

    They are as they fit best, nothing free; those with `known` labels, named or adjusted, are left out, and
    all where the fit fails.
    """
    fitted = final.fitted
    own = fitter.of(final.stack, fitted.views)
    conditions = [view.conditions for view in fitted.views]
    missing = [effect for effect in everyday(conditions, fitted.effects) if effect.base.varies]
    begun = _best(own, all_around([*fitted.continued(), *missing]), fitted)
    if not np.isfinite(begun.chi2):
        return []
    best = _best(own, [begun.continued(), *on_other_sides(begun)], begun)
    if not np.isfinite(best.chi2):
        best = begun
    facts = [label for label in best.problem.effects.labels if best.effect(label).base.varies]
    exact = needless(best, facts, own.stack, WORTH)
    free = [label for label in facts if label not in exact and label not in known]
    return [FixedEffect(best.effect(label).base, best.values_of(label)) for label in free]


def _best(fitter: Fitter, starts: Sequence[Sequence[Effect]], near: Fitted) -> Fitted:
    """The best fit of effects from some starts."""
    return min((fitter.explored(effects, near) for effects in starts), key=lambda one: one.chi2)
