"""`seeing_halo`: the long-exposure OTF of the AO residual, ``exp(-½ (2π/λ)² D(b))``.

The structure function D is that of the residual inside the correction band (free variance,
slope, two-fold and four-fold anisotropy; the variance, because ∂μ/∂σ vanishes at σ = 0) plus that of the
von Kármán turbulence beyond it, which the seeing fixes: its light falls mostly outside a window
of 0.6", where it cannot be told from flux and background.
"""

from __future__ import annotations

import numpy as np
import torch

from ..optics.structure import (
    InBandResidual,
    ResidualBand,
    fitting_structure_nm2,
    fitting_variance_nm2,
    seeing_to_r0_m,
)
from .base import Conditions, OtfGrid, Parameter

NM = 1e-9
WFE_PER_ARCSEC_NM, WFE_FLOOR_NM = 104.27, 58.6  # total residual against seeing, GALACSI test report 2019


def in_band_wfe_nm(band: ResidualBand, seeing_arcsec: float) -> float:
    """Residual inside the correction band expected at a seeing [nm RMS]."""
    total = WFE_PER_ARCSEC_NM * seeing_arcsec + WFE_FLOOR_NM
    fitting = fitting_variance_nm2(band, seeing_to_r0_m(seeing_arcsec))
    return float(np.sqrt(max(total**2 - fitting, (0.3 * total) ** 2)))


class SeeingHalo:
    """Averaged speckle and halo of the residual wavefront.

    Parameters
    ----------
    band : ResidualBand
    seeing_arcsec : float
        Sets the turbulence beyond the cut-off, and the in-band residual to start from.
    """

    name = "seeing_halo"

    def __init__(self, band: ResidualBand, seeing_arcsec: float):
        self.band, self.r0_m = band, seeing_to_r0_m(seeing_arcsec)
        expected = in_band_wfe_nm(band, seeing_arcsec)
        self.fitting_nm2 = fitting_variance_nm2(band, self.r0_m)
        self.parameters = (
            Parameter("variance_nm2", "nm²", expected**2, expected**2, 2 * expected**2, 0.0, 1e6),
            Parameter("slope", "", 2.0, 2.0, 1.0, -1.0, 6.0),
            Parameter("stretch_cos", "", 0.0, 0.0, 0.7, -3.0, 3.0),
            Parameter("stretch_sin", "", 0.0, 0.0, 0.7, -3.0, 3.0),
            Parameter("cross_cos", "", 0.0, 0.0, 0.5, -2.0, 2.0),
            Parameter("cross_sin", "", 0.0, 0.0, 0.5, -2.0, 2.0),
        )
        self._grid: OtfGrid | None = None

    @classmethod
    def under(cls, conditions: Conditions) -> SeeingHalo:
        """See `OtfEffect.under`."""
        return cls(conditions.band, conditions.seeing_arcsec)

    def exponent(self, values: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """``½ (2π/λ)² D(b)``, D in nm²."""
        self._prepare(grid)
        structure = self._in_band.structure_nm2(*values) + self._fitting
        return 0.5 * (2 * np.pi * NM / grid.wavelengths_m) ** 2 * structure

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """In-band WFE, total WFE, PSD slope, strength and direction of the elongation, four-fold strength."""
        variance, slope, cos2, sin2, cos4, sin4 = (float(v) for v in values)
        return {
            "wfe_nm": float(np.sqrt(variance + self.fitting_nm2)),
            "in_band_wfe_nm": float(np.sqrt(variance)),
            "slope": slope,
            "stretch": float(np.hypot(cos2, sin2)),
            "stretch_angle_deg": float(np.rad2deg(np.arctan2(sin2, cos2)) / 2 % 180),
            "cross": float(np.hypot(cos4, sin4)),
        }

    def values_of(self, wfe_nm: float) -> list[float]:
        """Solver's parameters for a known total residual [nm RMS], its shape as expected."""
        return [max(wfe_nm**2 - self.fitting_nm2, 0.0), *(p.start for p in self.parameters[1:])]

    def _prepare(self, grid: OtfGrid) -> None:
        """Quadrature matrices for these baselines, made once."""
        if self._grid is grid:
            return
        bx, by = np.broadcast_arrays(grid.baseline_x_m[None, :], grid.baseline_y_m[:, None])
        self._in_band = InBandResidual(bx, by, self.band)
        self._fitting = torch.as_tensor(fitting_structure_nm2(np.hypot(bx, by), self.band, self.r0_m))
        self._grid = grid
