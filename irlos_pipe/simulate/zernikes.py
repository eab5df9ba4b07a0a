"""Zernike polynomials, Noll index and normalisation (R. J. Noll, JOSA 66, 207, 1976)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import eval_jacobi


def noll_orders(noll: int) -> tuple[int, int]:
    """Return radial order n and signed azimuthal order m (m < 0: sine) of the index `noll`."""
    n = int((np.sqrt(8 * noll - 7) - 1) // 2)
    rank = noll - n * (n + 1) // 2  # 1 .. n + 1 within the order
    m = 2 * (rank // 2) if n % 2 == 0 else 2 * ((rank - 1) // 2) + 1
    return n, m if noll % 2 == 0 else -m


def zernike(noll: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return Zernike `noll` at (`x`, `y`) in units of the radius, of unit RMS and continued beyond 1.

    θ counts from +x towards +y.

    ``R_n^m(r) = (-1)^k r^m P_k^(m, 0)(1 - 2 r²)`` with ``k = (n - m) / 2`` and Jacobi's P.
    """
    n, m = noll_orders(noll)
    k = (n - abs(m)) // 2
    radial = (-1) ** k * eval_jacobi(k, abs(m), 0, 1 - 2 * (x**2 + y**2))
    turned = (x + 1j * y) ** abs(m)  # r^m exp(i m theta)
    azimuthal = turned.real if m >= 0 else turned.imag
    return np.sqrt((n + 1) * (1 if m == 0 else 2)) * radial * azimuthal


def rotated_nm(zernike_nm: Mapping[int, float], angle_deg: float) -> dict[int, float]:
    """Return the coefficients `zernike_nm` of a wavefront turned anticlockwise by `angle_deg`."""
    turned: dict[int, float] = {}
    for noll, value_nm in zernike_nm.items():
        _, m = noll_orders(noll)
        angle = np.deg2rad(m * angle_deg)
        _add(turned, noll, value_nm * float(np.cos(angle)))
        if m != 0:
            _add(turned, _partner(noll), value_nm * float(np.sin(angle)))
    return turned


def _add(coefficients: dict[int, float], noll: int, value: float) -> None:
    coefficients[noll] = coefficients.get(noll, 0.0) + value


def _partner(noll: int) -> int:
    """Noll index of the same mode turned by a quarter of its period."""
    n, m = noll_orders(noll)
    return noll + 1 if noll_orders(noll + 1) == (n, -m) else noll - 1
