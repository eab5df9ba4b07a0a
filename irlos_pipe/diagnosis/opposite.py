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
import torch

from irlos_pipe.diagnosis.fitting import POINTING, Fitted, Fitter, begun_at
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import OppositeSide
from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.base import AT_REST, direction_among
from irlos_pipe.numerics.solver import ROUNDING

DIRECTIONS = 8  # in which the fit is searched for a fall from no distance, where the image has a kink


def opposite_side(fitter: Fitter, final: Optimum, label: str, sure: float) -> OppositeSide | None:
    """The `final` fit with an effect of the pupil on its opposite side, unless the data exclude that.

    The data exclude it from a significance of `sure` on, in Gaussian σ. None as well for effects without a
    direction in the pupil, and where the fit leads back.
    """
    fitted = final.fitted
    if label not in fitted.problem.effects.labels or fitted.effect(label).plane != "pupil":
        return None
    angle, side = direction_among(fitted.effect(label).parameters), other_side(fitted, label)
    if angle is None or side is None:
        return None
    own, effects = fitter.of(final.stack, fitted.views), fitted.continued_by_label()
    effects[label] = begun_at(effects[label], side)
    other = own.explored([*effects.values()], fitted)
    rise = own.rise_between(fitted, other)
    turned = float((other.x - fitted.x)[0, fitted.columns_of(label)[angle]])
    if not np.isfinite(other.chi2) or np.cos(turned) >= 0 or rise >= sure**2:
        return None
    base, values = other.effect(label).base, other.values_of(label)
    public = base.describe(values)
    change_nm = float(np.linalg.norm((other.modes_nm - fitted.modes_nm)[POINTING:]))
    return OppositeSide(public, base.phrase(public), rise, change_nm)


def other_side(fitted: Fitted, label: str) -> np.ndarray | None:
    """Other values of an effect with a distance and a direction; None of an effect without.

    What has a distance begins on the opposite side, which is degenerate to first order. What began on the
    wrong side came to rest at no distance, where the image has a kink; it begins where the fit falls most
    steeply from there, or nowhere else if it rises on all sides.
    """
    effect = fitted.effect(label)
    angle, values = direction_among(effect.parameters), fitted.x[0, fitted.columns_of(label)].numpy().copy()
    if angle is None:
        return None
    if values[0] > effect.parameters[0].lower + AT_REST:
        values[angle] += np.pi
        return values
    downhill = _downhill(fitted, label, angle)
    if downhill is None:
        return None
    values[0], values[angle] = effect.base.parameters[0].start, downhill
    return values


def _downhill(fitted: Fitted, label: str, angle: int) -> float | None:
    """The direction in which the fit falls most from no distance; None if it falls in none.

    All other parameters are where they are best, so that to first order they would stay.
    """
    columns, which = fitted.columns_of(label), torch.zeros(1, dtype=torch.int64)

    def objective(distance: float, direction: float) -> float:
        x = fitted.x.clone()
        x[0, columns[0]] = fitted.effect(label).parameters[0].lower + distance
        x[0, columns[angle]] = direction
        return float(fitted.problem.objective(x, which))

    centred = objective(0.0, 0.0)
    directions = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    values = [objective(AT_REST, direction) for direction in directions]
    return float(directions[np.argmin(values)]) if min(values) < centred * (1 - ROUNDING) else None


WORTH = 1.5  # standard errors by which a fact must be off to be worth its freedom, some √2


def open_facts(final: Optimum, known: Sequence[str]) -> list[FixedEffect]:
    """Return those facts of the `final` model that are off by more than `WORTH`.

    They are as they fit best, nothing free; those with `known` labels, named or adjusted, are left out.
    """
    fitted, found = final.fitted, []
    for label in fitted.problem.effects.labels:
        effect, columns = fitted.effect(label), fitted.columns_of(label)
        sigma = fitted.solution.covariance[0].diagonal()[columns] ** 0.5
        rows = zip(effect.parameters, fitted.x[0, columns].tolist(), sigma.tolist(), strict=True)
        off = any(p.null is not None and abs(value - p.null) > WORTH * error for p, value, error in rows)
        if effect.base.varies and label not in known and off:
            found.append(FixedEffect(effect.base, fitted.values_of(label)))
    return found
