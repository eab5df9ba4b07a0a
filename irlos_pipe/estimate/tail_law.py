"""The law of the modes beyond the closed basis, ``std(n) = A (n/n₁)^(−p)`` by radial order n, by evidence.

One recording is one draw of every mode, but there are dozens of modes per parameter of the law. Around the
optimum the model is linear, so everything but A and p integrates out (Laplace; MacKay 1992, Neural Comput.
4, 415): with the curvature S of χ²/2 in the tail, all other parameters marginalised, and b = S â of the
unconstrained optimum â,

    ln evidence = ½ bᵀ(S + C⁻¹)⁻¹ b − ½ ln det(S + C⁻¹) − ½ ln det C,    C = diag std²(n)

Without a tail A falls to what the noise allows, and the modes beyond the closed basis with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from irlos_pipe.optics.zernike import noll_to_nm

# Of ln A [nm] and p before anything is known: wide, they only close the law where there is no tail at all.
EXPECTED, WIDTH = np.array([0.0, 1.0]), np.array([3.0, 2.0])
FIRST_SIMPLEX = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])


@dataclass(frozen=True)
class TailLaw:
    """Standard deviation of the modes beyond the closed basis.

    Attributes
    ----------
    first_noll : int
        First of these modes.
    amplitude_nm : float
        A, that of a mode of the first's radial order n₁ [nm RMS].
    slope : float
        p.
    """

    first_noll: int
    amplitude_nm: float = 2.0
    slope: float = 1.0

    def sigma_nm(self, nolls: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the standard deviation of modes, (modes,) [nm RMS]."""
        order = np.array([noll_to_nm(int(noll))[0] for noll in nolls], float)
        return self.amplitude_nm * (order / noll_to_nm(self.first_noll)[0]) ** -self.slope


def fit_tail_law(
    law: TailLaw, nolls: Sequence[int], values: np.ndarray, hessian: np.ndarray, precision: np.ndarray
) -> TailLaw:
    """Fit the law by evidence at the optimum found with another one.

    Parameters
    ----------
    law : TailLaw
        Where the search begins, and what modes it is about.
    nolls : sequence of int
        Modes, the first parameters.
    values : ndarray, (parameters,)
        The optimum.
    hessian : ndarray, (parameters, parameters)
        Of half of χ² there, priors included.
    precision : ndarray, (parameters,)
        Of the priors.
    """
    tail = np.zeros(len(values), bool)
    tail[: len(nolls)] = np.asarray(nolls) >= law.first_noll
    modes = np.asarray(nolls)[tail[: len(nolls)]]
    cross = _pseudo_inverse(hessian[np.ix_(~tail, ~tail)]) @ hessian[np.ix_(~tail, tail)]
    marginal = hessian[np.ix_(tail, tail)] - hessian[np.ix_(tail, ~tail)] @ cross
    pull = marginal @ values[tail]  # b: priors pull the tail to 0, so the optimum is (S + C⁻¹)⁻¹ b
    curvature = marginal - np.diag(precision[tail])

    def deviance(x: np.ndarray) -> float:
        own = TailLaw(law.first_noll, float(np.exp(x[0])), float(x[1])).sigma_nm(modes)
        factor = cho_factor(curvature + np.diag(own**-2), lower=True)
        spread = 2 * np.log(np.diag(factor[0])).sum() + 2 * np.log(own).sum()
        return float(spread - pull @ cho_solve(factor, pull) + np.sum(((x - EXPECTED) / WIDTH) ** 2))

    start = np.array([np.log(law.amplitude_nm), law.slope])
    tolerances = {"xatol": 0.02, "fatol": 0.02, "initial_simplex": start + FIRST_SIMPLEX}
    found = minimize(deviance, start, method="Nelder-Mead", options=tolerances).x
    return TailLaw(law.first_noll, float(np.exp(found[0])), float(found[1]))


def _pseudo_inverse(matrix: np.ndarray) -> np.ndarray:
    """Of normal equations of parameters in different units, of which some may not be determined."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    per = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    return np.linalg.pinv(matrix * np.outer(per, per), rcond=1e-12, hermitian=True) * np.outer(per, per)
