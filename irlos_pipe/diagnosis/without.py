"""A model without some of its effects: where the others would go, and which it needs, by a linear model.

Of many effects fitted jointly those that are dispensable are taken out one by one, linearly. At the optimum
of a joint fit the estimates β have a covariance C. Holding some of them, b, at zero raises χ² by ``βᵦᵀ C_bb⁻¹
βᵦ`` and moves the others by ``−C_ab C_bb⁻¹ βᵦ`` (Wald 1943, Trans. AMS 54, 426): effects that imitate each
other lose significance only until one of them is gone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.effect_sizes import parameter_covariance
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.diagnosis.significance import gaussian_sigma


def nulls_of(fitted: Fitted, label: str) -> dict[int, float]:
    """Values without effect of those parameters that have one, by column."""
    pairs = zip(fitted.columns_of(label), fitted.effect(label).parameters, strict=True)
    return {column: parameter.null for column, parameter in pairs if parameter.null is not None}


def needless(fitted: Fitted, labels: Sequence[str], stack: Stacks, sure: float) -> set[str]:
    """Labels of dispensable effects: not significant jointly with all others of a model.

    They are taken out one by one. The scatter of the `stack` sets the errors; `sure` is the significance in σ
    below which an effect is dispensable. What has no null is never in question.
    """
    columns, test = _wald_test(fitted, labels, stack, sure)
    return set(columns) - set(test(columns))


def imitated(fitted: Fitted, labels: Sequence[str], stack: Stacks, sure: float) -> set[str]:
    """Labels of effects that are not significant while all others of a model stay in it, see `needless`."""
    columns, test = _wald_test(fitted, labels, stack, sure)
    return {label for label, own in columns.items() if not test({label: own})}


def _wald_test(
    fitted: Fitted, labels: Sequence[str], stack: Stacks, sure: float
) -> tuple[dict[str, list[int]], Callable[[Mapping[str, Sequence[int]]], list[str]]]:
    """Columns of the effects that may be nothing, and a test that names those of some which are needed."""
    nulls = {label: own for label in labels if (own := nulls_of(fitted, label))}
    columns = {label: [*own] for label, own in nulls.items()}
    if not nulls:
        return columns, lambda _: []
    null = np.zeros(fitted.problem.size)
    for own in nulls.values():
        null[[*own]] = [*own.values()]
    frames = np.inf if stack.photon_limited else stack.independent
    apart, covariance = fitted.x[0].numpy() - null, parameter_covariance(stack, fitted)

    def significance(rise: float, count: int) -> float:
        return gaussian_sigma(max(rise, 0.0), count, frames)

    return columns, lambda some: needed(some, apart, covariance, significance, sure)


def without_linearly(fitted: Fitted, label: str) -> Fitted:
    """A model with one effect at nothing, the others at the optimum of a linear model if that is better."""
    nulls, x = nulls_of(fitted, label), fitted.x.clone()
    own = [*nulls]
    covariance, moved = fitted.solution.covariance[0], x.clone()
    excess = x[0, own] - torch.tensor([*nulls.values()], dtype=x.dtype)
    moved[0] -= covariance[:, own] @ torch.linalg.pinv(covariance[own][:, own], hermitian=True) @ excess
    x[0, own] -= excess
    moved = moved.clamp(fitted.problem.lower, fitted.problem.upper)
    values = min(x, moved, key=lambda one: _chi2_at(fitted, one))
    return replace(fitted, solution=replace(fitted.solution, values=values))


def _chi2_at(fitted: Fitted, x: torch.Tensor) -> float:
    """χ² there; infinite where nothing can be computed."""
    try:
        chi2 = float(fitted.problem.chi2(x))
    except ValueError:
        return float("inf")
    return chi2 if np.isfinite(chi2) else float("inf")


def needed(
    columns: Mapping[str, Sequence[int]],
    estimates: np.ndarray,
    covariance: np.ndarray,
    significance: Callable[[float, int], float],
    sure: float,
) -> list[str]:
    """Names of the effects that are significant when all that are not have been taken out.

    `columns` has the parameters of every effect in question, `estimates` (parameters,) the distance of each
    from where it has no effect, with their `covariance` (parameters, parameters). `significance` gives
    Gaussian σ from the rise of χ² and the number of parameters; below `sure` an effect is taken out.
    """
    left = dict(columns)
    beta, cov = np.array(estimates, float), np.array(covariance, float)
    while left:
        found = {name: significance(_rise(beta, cov, own), len(own)) for name, own in left.items()}
        least = min(found, key=lambda name: found[name])
        if found[least] > sure:
            break
        own = list(left.pop(least))
        gain = cov[:, own] @ np.linalg.pinv(cov[np.ix_(own, own)])
        beta, cov = beta - gain @ beta[own], cov - gain @ cov[own]
    return list(left)


def _rise(beta: np.ndarray, cov: np.ndarray, own: Sequence[int]) -> float:
    """Rise of χ² without some parameters."""
    own = list(own)
    return float(beta[own] @ np.linalg.pinv(cov[np.ix_(own, own)]) @ beta[own])
