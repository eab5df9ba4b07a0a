"""The UT4 entrance pupil and the Noll Zernikes on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hcipy import (
    CartesianGrid,
    evaluate_supersampled,
    make_obstructed_circular_aperture,
    make_pupil_grid,
    make_spider,
    noll_to_zernike,
    zernike,
)

DIAMETER_M = 8.0
OBSCURATION_M = 1.116
VANE_WIDTH_M = 0.040
VANE_ORIGIN_M = (
    0.4045 / np.cos(np.deg2rad(39.5)) / np.sqrt(2)
)  # x and y of the origin on the +45 deg diagonal
VANE_TIP_M = 4.2197
LAST_NOLL = 51


def ut4_aperture(grid):
    """Return the transmission of the UT4 pupil (0 or 1) at the points of an HCIPy grid."""
    transmission = make_obstructed_circular_aperture(DIAMETER_M, OBSCURATION_M / DIAMETER_M)(grid)
    for side in (1, -1):
        origin = (side * VANE_ORIGIN_M, side * VANE_ORIGIN_M)
        for tip in ((side * VANE_TIP_M, 0.0), (0.0, side * VANE_TIP_M)):
            transmission = transmission * make_spider(origin, tip, VANE_WIDTH_M)(grid)
    return transmission


@dataclass(frozen=True)
class Telescope:
    """Sampled pupil; rows are y, columns x."""

    grid: CartesianGrid  # symmetric about the optical axis [m]
    transmission: np.ndarray  # (n, n), area-weighted, 0 to 1
    modes: np.ndarray  # (LAST_NOLL, n, n): Noll 1 to LAST_NOLL, unit RMS over the unobscured disc

    @property
    def step_m(self) -> float:
        return float(self.grid.delta[0])

    def opd_nm(self, zernike_nm: dict[int, float]) -> np.ndarray:
        """Return the OPD (n, n) [nm] of Noll coefficients [nm RMS]."""
        coefficients = np.zeros(LAST_NOLL)
        for noll, value_nm in zernike_nm.items():
            coefficients[noll - 1] = value_nm
        return np.tensordot(coefficients, self.modes, axes=1)

    def fit_zernike_nm(
        self, opd_nm: np.ndarray, stated_nm: dict[int, float], last_noll: int = 31
    ) -> dict[int, float]:
        """Return the coefficients [nm RMS] of Noll 2..last_noll of a wavefront over the pupil.

        Of the wavefront, stated_nm are known coefficients, Noll: nm RMS, and exact in the result; the rest is
        a least-squares fit. Piston is fitted along and left out; every sample counts with its transmission.
        Were all of it fitted, stated modes beyond the last would fall on the others, because over an obscured
        pupil they are not orthogonal.
        """
        lit = self.transmission > 0
        weight = np.sqrt(self.transmission[lit])
        design = self.modes[:last_noll, lit].T * weight[:, None]
        rest_nm = opd_nm - self.opd_nm(stated_nm)
        solution = np.linalg.lstsq(design, rest_nm[lit] * weight, rcond=None)[0]
        return {
            noll: stated_nm.get(noll, 0.0) + float(solution[noll - 1]) for noll in range(2, last_noll + 1)
        }


def build_telescope(samples: int = 240, supersampling: int = 12) -> Telescope:
    """Return the UT4 pupil on samples x samples points, each averaged over supersampling^2 points."""
    grid = make_pupil_grid(samples, DIAMETER_M)
    transmission = evaluate_supersampled(ut4_aperture, grid, supersampling)
    orders = (noll_to_zernike(noll) for noll in range(1, LAST_NOLL + 1))
    modes = [zernike(n, m, D=DIAMETER_M, grid=grid, radial_cutoff=False).shaped for n, m in orders]
    return Telescope(grid, np.asarray(transmission.shaped), np.array(modes))


def tilt_nm(angle_mas: float) -> float:
    """Return the Noll 2 (or 3) coefficient [nm RMS] that moves the image by angle_mas: OPD = angle * x."""
    angle_rad = np.deg2rad(angle_mas / 3.6e6)
    return float(angle_rad * DIAMETER_M / 4 * 1e9)
