"""Whether recordings of several moments share what was named, or each has its own.

A name is fitted once with one value for all moments and once with a value for each. How significantly χ²
falls by the latter, and which of the two models frames prefer that no fit has seen, says whether it is the
instrument's. A name that only one moment shows may still be in the others, too
weak to be seen there: then neither is said.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.diagnosis.acceptance import DECIDED, Search, preference
from irlos_pipe.diagnosis.cube import Cube, Stacks
from irlos_pipe.diagnosis.effect_sizes import Covariances, parameter_covariance
from irlos_pipe.diagnosis.fitting import Fitted, Fitter
from irlos_pipe.diagnosis.null_model import Optimum, gaussian_sigma
from irlos_pipe.diagnosis.records import Options, OwnValueRow, SharingRow, Star
from irlos_pipe.diagnosis.view import Moments
from irlos_pipe.effects import Effect, FixedEffect
from irlos_pipe.effects.public_values import public_sigma

SEEN = 5.0  # significance from which a moment by itself shows an effect
MEASURED = 1e-9  # eigenvalue of a correlation matrix below which it is rounding


@dataclass(frozen=True)
class Together:
    """What the moments of a multi-epoch diagnosis share."""

    moments: Moments
    # Of every effect that was named, in the order of the steps, by its labels in the model: one for all
    # moments, or several that act in some.
    sharing: Mapping[tuple[str, ...], SharingRow]
    stars: Sequence[Star]  # how much the wavefront of every moment differs from the mean of all


def sharing(
    labels: Sequence[str], fitted: Fitted, fitter: Fitter, cube: Cube, moments: Moments, sure: float
) -> SharingRow:
    """Compare one value for all moments with a value for each; they differ from a significance of `sure` on.

    In the model the effect has one of the `labels` for all moments, or several that act in some. It is open
    whether they share it where fewer than two moments show it and the others do not exclude it.
    """
    others = fitted.continued_by_label()
    chosen = [others.pop(label) for label in [*others] if label in labels]
    own = [_own_of(number, chosen) for number in moments.by_number]
    apart = fitter.fit([*others.values(), *own], fitted)
    one_for_all = FixedEffect(
        chosen[0].base.only_in(None), _values_of(chosen[0]), [p.name for p in chosen[0].parameters]
    )
    together = fitter.fit([*others.values(), one_for_all], fitted)
    stack = cube.training
    misfit = max(1.0, Optimum(stack, apart).excess.chi2_nu)  # what both models miss is no difference
    more = len(apart.effect_values) - len(together.effect_values)
    significance = Optimum(stack, together).significance_of_change(apart, more, misfit=misfit)
    covariances = Covariances(stack, apart, misfit)
    pairs = [*zip(apart.problem.effects.labels, apart.effects, strict=True)]
    values = []
    for number, moment in moments.by_number.items():
        # the effect of this name that was put into the moment last
        label = [
            one for one, effect in pairs if effect.name == chosen[0].name and effect.acts_in == {number}
        ][-1]
        values.append(_value(moment.name, apart, label, covariances.of(label), stack))
    z = preference(cube.held_out, apart, together)
    seen = sum(one.significance > SEEN for one in values)
    differs = significance > sure and z > DECIDED
    finding = "differs" if differs else "common" if seen > 1 else "open"
    return SharingRow(labels[0], finding, significance, together.chi2 - apart.chi2, more, z, values)


def _values_of(effect: Effect) -> np.ndarray:
    return effect.all_values([p.start for p in effect.parameters]).numpy()


def _own_of(number: int, chosen: Sequence[Effect]) -> FixedEffect:
    """The effect in one moment: as it is there, or absent at the place where others have it."""
    acting = [effect for effect in chosen if effect.acting(number)]
    effect = (acting or chosen)[0]
    values = _values_of(effect)
    free = list(effect.parameters)
    if not acting:
        free = [p for p in free if p.null is not None]
        absent = [p.null for p in effect.base.parameters]
        values = np.array([v if null is None else null for v, null in zip(values, absent, strict=True)])
    return FixedEffect(effect.base.only_in(frozenset({number})), values, [p.name for p in free])


def _value(moment: str, fitted: Fitted, label: str, covariance: np.ndarray, stack: Stacks) -> OwnValueRow:
    """What a moment has of the effect with this `label`, whose parameters have a `covariance`."""
    effect, values = fitted.effect(label), fitted.values_of(label)
    sized = [i for i in effect.free if effect.base.parameters[i].null is not None]
    null = np.array([effect.base.parameters[i].null for i in sized], float)
    frames = np.inf if stack.photon_limited else stack.independent
    significance = _wald(values[sized] - null, covariance[np.ix_(sized, sized)], frames)
    public = effect.base.describe(values), public_sigma(effect.base, values, covariance)
    return OwnValueRow(moment, *public, significance)


def _wald(estimate: np.ndarray, covariance: np.ndarray, frames: float) -> float:
    """Significance of an estimate against zero, in Gaussian σ."""
    if not len(estimate):
        return 0.0
    unit = np.sqrt(np.diag(covariance).clip(1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    measured = values > MEASURED
    along = (estimate / unit) @ vectors[:, measured]
    return gaussian_sigma(float(along @ (along / values[measured])), int(measured.sum()), frames)


def together(search: Search, fitter: Fitter, cube: Cube, moments: Moments, options: Options) -> Together:
    """Compare the moments, of which there are several, in what was found."""
    fitted = search.final.fitted
    fitter = fitter.of(search.final.stack, fitted.views)
    groups: dict[str, list[str]] = {}  # labels; those of one kind of which a model has one are in one group
    for one in search.accepted:
        effect = fitted.effect(one.label)
        groups.setdefault(one.label if effect.repeatable else effect.name, []).append(one.label)
    found = {
        tuple(labels): sharing(labels, fitted, fitter, cube, moments, options.sure)
        for labels in groups.values()
    }
    return Together(moments, found, _stars(search, moments))


def _stars(search: Search, moments: Moments) -> list[Star]:
    """Changes from the mean of all moments, which images determine better than those from the common part."""
    final, drifts = search.final, search.final.fitted.problem.drifts
    columns = np.array([drifts[number] for number in moments.by_number])  # (moments, modes)
    covariance = parameter_covariance(final.stack, final.fitted)
    from_mean = np.eye(len(columns)) - 1 / len(columns)
    changes = from_mean @ final.fitted.x[0].numpy()[columns]
    of_modes = covariance[columns.T[:, :, None], columns.T[:, None, :]]  # (modes, moments, moments)
    variances = np.diagonal(from_mean @ of_modes @ from_mean.T, axis1=1, axis2=2).T
    return [
        Star(
            moment.name, moment.star, *(float(np.sqrt(np.mean(squares))) for squares in (change**2, variance))
        )
        for moment, change, variance in zip(moments.by_number.values(), changes, variances, strict=True)
    ]
