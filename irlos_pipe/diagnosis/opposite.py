"""Whether an effect fits as well on its opposite side, which a standard error does not say.

A stop that is moved one way and one that is moved the other way make the same image to first order, but for
the even part of the wavefront. Odd modes imitate the rest: behind a strong AO residual both sides may fit.
"""

from __future__ import annotations

import numpy as np

from irlos_pipe.diagnosis.fitted import Fitted, begun_at
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.joint_fit import POINTING
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import OppositeSide
from irlos_pipe.diagnosis.starts import direction_of, other_sides


def opposite_side(fitter: Fitter, final: Optimum, label: str, sure: float) -> OppositeSide | None:
    """The fit with an effect of the pupil on its opposite side, unless the data exclude it.

    Parameters
    ----------
    fitter : Fitter
    final : Optimum
        Of the model with the effect.
    label : str
        Of the effect there.
    sure : float
        Significance from which that side is excluded, in Gaussian σ.

    Returns
    -------
    OppositeSide or None
        None as well for effects without a direction in the pupil, and where the fit leads back.
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
