"""`ao_cutoff`: the AO corrects up to another spatial frequency than the profile of the instrument states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import scipy

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.units import MAS, NM
from irlos_pipe.effects.declaration import Conditions, Parameter, number
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.effects.seeing_halo import in_band_wfe_nm, require_residual
from irlos_pipe.optics.fourier_matrices import FocalGrid
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.structure_function import ResidualBand, seeing_to_r0_m, von_karman_nm2

NODES = 24  # of the quadrature between the two cut-offs
OFF = 0.2  # σ of the prior, as a fraction of the declared cut-off
FARTHEST = 2.0  # largest factor from the declared cut-off that a fit may reach, either way


class AoCutoff(OtfEffect):
    """The correction of the AO ends at another spatial frequency than told, and the halo begins there.

    Between the two cut-offs there is turbulence in place of what the AO is expected to leave inside its band,
    or the reverse. Elsewhere the residual is that of `seeing_halo`.

    It is looked for where the image shows the edge of the corrected field, λ times the cut-off from the star.
    Errors do not hold how far the residual inside the band is from the expected one: some per cent.

    Parameters
    ----------
    band : ResidualBand
        With the cut-off as told.
    law : ResidualLaw
        AO residual against seeing.
    seeing_arcsec : float
        Strength of the turbulence.
    """

    name = "ao_cutoff"
    formula = (
        "T(b) = exp(−½ (2π/λ)² (D(b; cut-off) − D(b; cut-off as told))); D: turbulence beyond the cut-off, a "
        "residual as f^−2 inside"
    )
    fact = True
    public = (number("per_m", "1/m, the cut-off, not its change", 1e-3, 1e6),)
    sentence = "a correction that ends at {per_m:.3f} cycles per metre"
    look_alike = "seeing_halo, which has no edge; without one in the window, flux and background"
    reference = "Fétick et al. 2019, A&A 628, A99"

    def __init__(self, band: ResidualBand, law: ResidualLaw, seeing_arcsec: float):
        declared = band.cutoff_per_m
        self.band, self.r0_m = band, seeing_to_r0_m(seeing_arcsec)
        in_band_nm2 = in_band_wfe_nm(band, law, seeing_arcsec) ** 2
        self._in_band_nm2 = in_band_nm2 / (2 * np.pi * np.log(declared / band.low_per_m))  # times f^-2
        self.parameters = (
            Parameter(
                "per_m",
                "1/m",
                declared,
                declared,
                OFF * declared,
                max(declared / FARTHEST, band.low_per_m),
                declared * FARTHEST,
                declared,
                (declared / FARTHEST, declared * FARTHEST),
            ),
        )

    @classmethod
    def under(cls, conditions: Conditions) -> AoCutoff:
        """See `Effect.under`: it means nothing without AO residual, or with the edge outside the window."""
        band = conditions.band
        edge_mas = conditions.settings.mean_nm * NM * band.cutoff_per_m / MAS
        if edge_mas > conditions.reach_mas:
            raise ValueError(
                f"the corrected field ends {edge_mas:.0f} mas from the star, outside the window "
                f"({conditions.reach_mas:.0f} mas)"
            )
        require_residual(conditions)
        return cls(band, conditions.residual_law, conditions.seeing_arcsec)

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        cutoff = float(values[0].detach())
        lengths, place = _baselines(grid.focal)
        between = torch.as_tensor(self._between_nm2(lengths, cutoff))
        # The quadrature is NumPy's: this carries its derivative, and adds nothing.
        between = between + self._slope_nm2(lengths, cutoff) * (values[0] - cutoff)
        return factor * torch.exp(_scale(grid) * between[place])

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        """See `OtfEffect.slopes`: the integrand at the cut-off."""
        lengths, place = _baselines(grid.focal)
        slope = self._slope_nm2(lengths, float(values[0].detach()))
        return [self.apply(values, factor, grid) * _scale(grid) * slope[place] for _ in wanted]

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: with the declared cut-off."""
        return f"{super().phrase(public)} instead of {self.band.cutoff_per_m:g}"

    def _between_nm2(self, lengths_m: np.ndarray, cutoff_per_m: float) -> np.ndarray:
        """What the structure function beyond a cut-off has more than that beyond the declared one [nm²]."""
        declared = self.band.cutoff_per_m
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        frequencies = declared + (cutoff_per_m - declared) * (nodes + 1) / 2
        return -(cutoff_per_m - declared) / 2 * self._per_frequency_nm2(lengths_m, frequencies) @ weights

    def _slope_nm2(self, lengths_m: np.ndarray, cutoff_per_m: float) -> Tensor:
        """Derivative of `_between_nm2` by the cut-off."""
        return torch.as_tensor(-self._per_frequency_nm2(lengths_m, np.array([cutoff_per_m]))[:, 0])

    def _per_frequency_nm2(self, lengths_m: np.ndarray, f_per_m: np.ndarray) -> np.ndarray:
        """Structure function by frequencies that are not corrected, (baselines, frequencies) [nm² m]."""
        turbulence_nm2 = von_karman_nm2(f_per_m, self.r0_m, self.band.outer_scale_m)
        power = 2 * np.pi * f_per_m * (turbulence_nm2 - self._in_band_nm2 / f_per_m**2)
        return 2 * power * (1 - scipy.special.j0(2 * np.pi * np.outer(lengths_m, f_per_m)))


def _scale(grid: OtfGrid) -> Tensor:
    """From a structure function [nm²] to the exponent of the OTF."""
    return -0.5 * (2 * np.pi * NM / grid.wavelengths_m) ** 2


@lru_cache(maxsize=4)
def _baselines(focal: FocalGrid) -> tuple[np.ndarray, Tensor]:
    """Different lengths of the baselines within the pupil [m], and the place of every baseline among them."""
    lengths = np.hypot(focal.baseline_x_m[None, :], focal.baseline_y_m[:, None])
    within = np.where(lengths <= focal.longest_m, lengths, 0.0)
    different, place = np.unique(np.round(within, 9), return_inverse=True)
    return different, torch.as_tensor(place.reshape(lengths.shape))
