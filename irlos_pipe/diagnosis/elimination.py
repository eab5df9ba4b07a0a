"""Which of many effects fitted together are needed: the others are taken out one by one, linearly.

At the optimum of a joint fit the estimates β have a covariance C. Holding some of them, b, at zero raises χ²
by ``βᵦᵀ C_bb⁻¹ βᵦ`` and moves the others by ``−C_ab C_bb⁻¹ βᵦ`` (Wald 1943, Trans. AMS 54, 426): effects that
imitate each other lose significance only until one of them is gone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np


def needed(
    columns: Mapping[str, Sequence[int]],
    estimates: np.ndarray,
    covariance: np.ndarray,
    significance: Callable[[float, int], float],
    sure: float,
) -> list[str]:
    """Names of the effects that are significant when all that are not have been taken out.

    Parameters
    ----------
    columns : mapping of str to sequence of int
        Parameters of every effect in question.
    estimates : ndarray, (parameters,)
        Distance from where each parameter has no effect.
    covariance : ndarray, (parameters, parameters)
    significance : callable
        In Gaussian σ, from the rise of χ² and the number of parameters.
    sure : float
        Below which an effect is taken out.
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
