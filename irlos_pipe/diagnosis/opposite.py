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

from collections.abc import Sequence

import numpy as np

from irlos_pipe.diagnosis.fitted import POINTING, Fitted, begun_at
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import OppositeSide
from irlos_pipe.diagnosis.starts import direction_of, other_sides
from irlos_pipe.effects import FixedEffect


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
    return fitter.explored([*effects.values()], fitted)


def _is_opposite(fitted: Fitted, other: Fitted, column: int) -> bool:
    """Whether the direction in a `column` points more away from where it was than towards it."""
    turned = float(other.x[0, column] - fitted.x[0, column])
    return bool(np.isfinite(other.chi2) and np.cos(turned) < 0)


WORTH = 1.5  # standard errors by which a fact must be off to be worth its freedom, some √2


def open_facts(final: Optimum, known: Sequence[str]) -> list[FixedEffect]:
    """Return those facts of the `final` model that are off by more than `WORTH`.

    They are as they fit best, nothing free; those with `known` labels, named or adjusted, are left out.
    """
    fitted, found = final.fitted, []
    for label in fitted.problem.effects.labels:
        effect = fitted.effect(label)
        if effect.base.varies and label not in known and _off(fitted, label):
            found.append(FixedEffect(effect.base, fitted.values_of(label)))
    return found


def _off(fitted: Fitted, label: str) -> bool:
    """Whether a parameter is off from its null by more than `WORTH` of its standard errors."""
    columns = fitted.columns_of(label)
    sigma = fitted.solution.covariance[0].diagonal()[columns] ** 0.5
    values = fitted.x[0, columns]
    rows = zip(fitted.effect(label).parameters, values.tolist(), sigma.tolist(), strict=True)
    return any(one.null is not None and abs(value - one.null) > WORTH * error for one, value, error in rows)
