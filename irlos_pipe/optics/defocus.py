"""The shape of defocus in a beam of high aperture.

A focus that moves by z along the axis changes the path of a ray at the angle θ by ``n z (1 - cos θ)``.
With the sine condition a ray leaves the pupil at ``ρ = sin θ / sin α``, α being the angle of the marginal
ray, so that ::

    OPD(ρ) = n z (1 - sqrt(1 - s² ρ²)),        s = sin α = NA / n

Its first term is the parabola of Noll 4; the others are spherical aberrations of rising order, in fixed
proportion to it. Below s = 0.1, a focal ratio of 5, they are less than 0.1 % of it.

Reference: Hopkins 1945, Proc. Phys. Soc. 55, 116; Gu 2000, Advanced Optical Imaging Theory, ch. 6.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.optics.grids import PupilGrid

SMALLEST = 3e-5  # part of Noll 4 below which a companion is left out: 0.02 nm of 500 nm
HIGHEST_SINE = 0.98  # beyond it the series converges slowly
NODES, ORDERS = 200, 40  # of the quadrature, and highest radial order


@lru_cache(maxsize=16)
def defocus_series(sine: float) -> dict[int, float]:
    """Return what accompanies one nm of Noll 4 when the focus moves: Noll index to nm RMS, Noll 4 included.

    The `sine` is NA / n at the side where the focus moves, 0 to `HIGHEST_SINE`; 0 is the parabola.
    """
    if not 0 <= sine <= HIGHEST_SINE:
        raise ValueError(
            f"the sine of the marginal ray is {sine:g}; it should lie from 0 to {HIGHEST_SINE:g}"
        )
    parts = _radial_parts(sine) if sine > 0 else {DEFOCUS: 1.0}
    ratios = {noll: part / parts[DEFOCUS] for noll, part in parts.items()}
    return {noll: ratio for noll, ratio in ratios.items() if noll == DEFOCUS or ratio > SMALLEST}


def defocus_nm_per_um(sine: float, index: float = 1.0) -> float:
    """Return Noll 4 [nm RMS] per µm by which the focus moves where the refractive index is `index`.

    The `sine`, above 0, is as of `defocus_series`.
    """
    return 1e3 * index * _radial_parts(sine)[DEFOCUS]


def shaped_modes(grid: PupilGrid, nolls: Sequence[int], sine: float) -> np.ndarray:
    """Return the Zernike polynomials `nolls` on a `grid`, Noll 4 with its companions, (modes, n, n).

    The `sine` is as of `defocus_series`.
    """
    modes = grid.modes(nolls).copy()
    if DEFOCUS in nolls and sine > 0:
        series = defocus_series(sine)
        modes[list(nolls).index(DEFOCUS)] = np.tensordot(list(series.values()), grid.modes([*series]), 1)
    return modes


@lru_cache(maxsize=16)
def _radial_parts(sine: float) -> dict[int, float]:
    """Noll 4, 11, 22, … of ``1 - sqrt(1 - s² ρ²)``.

    With t = ρ² they are shifted Legendre polynomials ``sqrt(2k + 1) P_k(2t - 1)`` of unit RMS over the disc.
    """
    x, weights = legendre.leggauss(NODES)
    path = 1 - np.sqrt(1 - sine**2 * (x + 1) / 2)
    parts = legendre.legvander(x, ORDERS // 2).T @ (weights / 2 * path)
    orders = range(2, ORDERS + 1, 2)
    return {n * (n + 1) // 2 + 1: float(np.sqrt(n + 1) * parts[n // 2]) for n in orders}
