"""Difference of the coma between two points of the pupil: its mean and variance over all pairs."""

from __future__ import annotations

import numpy as np

NODES = 16  # per axis: the squared differences are polynomials of degree 4 in both


def coma_between(lengths_m: np.ndarray, diameter_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return moments of ``ψ(x + b) - ψ(x)`` over a clear circle.

    They are over the points x for which x + b is inside, too. ψ is Noll 8 for a baseline b along x; turned,
    the moments hold for every baseline.

    Parameters
    ----------
    lengths_m : ndarray, (n,)
        Of the baselines; those beyond the diameter are taken for it.
    diameter_m : float

    Returns
    -------
    mean : ndarray, (n,)
        Of the coma along the baseline; that of the coma across it is 0.
    along, across : ndarray, (n,)
        Variance of the coma along the baseline, and across it.
    """
    lengths, inverse = np.unique(np.round(lengths_m, 9), return_inverse=True)
    b = np.minimum(2 * lengths / diameter_m, 2 - 1e-9)[:, None, None]
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    angle = np.pi / 2 * nodes[:, None]
    y = np.sqrt(1 - b**2 / 4) * np.sin(angle)
    reach = np.sqrt(1 - y**2) - b / 2  # either way from the middle of the two points
    middle = reach * nodes
    weight = np.cos(angle) * weights[:, None] * reach * weights
    along, across = _coma(middle + b / 2, y) - _coma(middle - b / 2, y)
    weight = weight / weight.sum((1, 2), keepdims=True)
    mean = np.sum(weight * along, (1, 2))
    variances = np.sum(weight * along**2, (1, 2)) - mean**2, np.sum(weight * across**2, (1, 2))
    return mean[inverse], variances[0][inverse], variances[1][inverse]


def _coma(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Noll 8 and 7 on the unit disc, (2, ...)."""
    radial = np.sqrt(8) * (3 * (x**2 + y**2) - 2)
    return np.stack([radial * x, radial * y])
