"""Zernike polynomials, Noll index and Noll normalisation (CONTRACT of signs: theta from +x towards +y).

Reference: R. J. Noll, "Zernike polynomials and atmospheric turbulence", JOSA 66, 207 (1976).
"""

from __future__ import annotations

from math import factorial, sqrt

import numpy as np


def noll_to_nm(noll: int) -> tuple[int, int]:
    """Return the radial order n and signed azimuthal order m of a Noll index.

    Positive m stands for cos(m theta), negative m for sin(|m| theta); even Noll
    indices are cosines.

    Raises
    ------
    ValueError
        If `noll` is below 1.
    """
    if noll < 1:
        raise ValueError(f"Noll indices start at 1, got {noll}")
    n = 0
    while (n + 1) * (n + 2) // 2 < noll:
        n += 1
    position = noll - n * (n + 1) // 2 - 1
    m = 2 * ((position + 1) // 2) if n % 2 == 0 else 2 * (position // 2) + 1
    return n, m if noll % 2 == 0 else -m


def radial_polynomial(n: int, m: int, rho: np.ndarray) -> np.ndarray:
    """Return the radial part R_n^|m| of degree `n` and order `m` on normalised radii `rho`, unnormalised."""
    m = abs(m)
    result = np.zeros_like(rho)
    for k in range((n - m) // 2 + 1):
        sign = -1 if k % 2 else 1
        coefficient = (
            sign
            * factorial(n - k)
            / (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
        )
        result = result + coefficient * rho ** (n - 2 * k)
    return result


def zernike(noll: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return one Zernike polynomial on points of the unit disc.

    Parameters
    ----------
    noll : int
        Noll index, 1 = piston.
    x, y : ndarray
        Coordinates in units of the pupil radius; points outside the unit disc get
        the polynomial's continuation, the pupil amplitude cuts it off.

    Returns
    -------
    ndarray, shape of `x`
        Unit RMS over the unobscured disc.
    """
    n, m = noll_to_nm(noll)
    rho, theta = np.hypot(x, y), np.arctan2(y, x)
    radial = radial_polynomial(n, m, rho) * sqrt(n + 1)
    if m == 0:
        return radial
    azimuthal = np.cos(m * theta) if m > 0 else np.sin(-m * theta)
    return sqrt(2) * radial * azimuthal


def zernike_basis(nolls, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return Zernike polynomials `nolls` at (`x`, `y`) in units of the radius, ``(len(nolls), *x.shape)``."""
    return np.stack([zernike(noll, x, y) for noll in nolls])
