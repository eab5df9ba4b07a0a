"""`seeing_halo`: the long-exposure OTF of the AO residual, ``exp(-½ (2π/λ)² D(b))``.

The structure function D is that of the residual inside the correction band (free variance,
slope, two-fold and four-fold anisotropy; the variance, because ∂μ/∂σ vanishes at σ = 0) plus that of the
von Kármán turbulence beyond it. The light of the latter falls mostly outside a window of 0.6", where it
cannot be distinguished from flux and background: the seeing fixes it, and where that was not measured, the
residual in the band.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.units import NM
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Calibrated, Conditions, Parameter, direction, number
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.optics.fourier_matrices import FocalGrid
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.structure_function import (
    InBandResidual,
    ResidualBand,
    fitting_structure_nm2,
    fitting_variance_nm2,
    seeing_to_r0_m,
)

FULL_HALO = 0.1  # of the expected variance, from which the shape of the halo is fitted as well


def in_band_wfe_nm(band: ResidualBand, law: ResidualLaw, seeing_arcsec: float) -> float:
    """Return the residual inside the correction `band` [nm RMS] that the `law` expects at `seeing_arcsec`."""
    total = law.wfe_nm(seeing_arcsec)
    fitting = fitting_variance_nm2(band, seeing_to_r0_m(seeing_arcsec))
    return float(np.sqrt(max(total**2 - fitting, (0.3 * total) ** 2)))


class SeeingHalo(OtfEffect):
    """Averaged speckle and halo of the residual wavefront.

    Parameters
    ----------
    band : ResidualBand
    law : ResidualLaw
        AO residual against seeing.
    seeing_arcsec : float
        Sets the turbulence beyond the cut-off, and the in-band residual to start from.
    measured : bool
        Whether the seeing was; otherwise the turbulence beyond the cut-off grows and falls with the in-band
        variance, in the proportion that the seeing gives.
    """

    name = "seeing_halo"
    formula = (
        "T(b) = exp(−½ (2π/λ)² D(b)); D: structure function of the residual OPD, its in-band variance "
        "and shape fitted"
    )
    belongs_to = "moment"
    usual = True
    public = (
        number("wfe_nm", "nm RMS in all", 0.0, 1000.0, required=False),
        number("scale", "of the WFE expected at the seeing", 0.0, 10.0, required=False),
    )
    derived = (
        number("in_band_wfe_nm", "nm RMS inside the correction band"),
        number("slope", "exponent of the spectrum inside the band"),
        number("stretch", "two-fold anisotropy"),
        direction("stretch_angle_deg"),
        number("cross", "four-fold anisotropy"),
    )
    speckles = True
    look_alike = "tip_tilt_jitter, which broadens the core instead of feeding a halo"
    reference = "Fétick et al. 2019, A&A 628, A99; Roddier 1981, Prog. Opt. 19, 281"

    def __init__(self, band: ResidualBand, law: ResidualLaw, seeing_arcsec: float, measured: bool = True):
        self.band, self.law, self.measured = band, law, measured
        self.r0_m = seeing_to_r0_m(seeing_arcsec)
        expected = in_band_wfe_nm(band, law, seeing_arcsec) ** 2
        self.fitting_nm2 = fitting_variance_nm2(band, self.r0_m)
        self.expected_nm2 = expected + self.fitting_nm2
        # Turbulence beyond the cut-off, of what the seeing gives: fixed, or in proportion to the variance.
        self._fixed, self._per_nm2 = (1.0, 0.0) if measured else (0.0, 1.0 / expected)
        self.parameters = (
            Parameter(
                "variance_nm2", "nm²", expected, expected, 2 * expected, 0.0, 1e6, None, (0.0, 400.0**2)
            ),
            Parameter("slope", "", 2.0, 2.0, 1.0, -1.0, 6.0, None, (0.0, 4.0)),
            Parameter("stretch_cos", "", 0.0, 0.0, 0.7, -3.0, 3.0, None, (-2.0, 2.0)),
            Parameter("stretch_sin", "", 0.0, 0.0, 0.7, -3.0, 3.0, None, (-2.0, 2.0)),
            Parameter("cross_cos", "", 0.0, 0.0, 0.5, -2.0, 2.0, None, (-2.0, 2.0)),
            Parameter("cross_sin", "", 0.0, 0.0, 0.5, -2.0, 2.0, None, (-2.0, 2.0)),
        )

    @classmethod
    def under(cls, conditions: Conditions) -> SeeingHalo:
        """See `Effect.under`: it means nothing on a bench without atmosphere."""
        if in_band_wfe_nm(conditions.band, conditions.residual_law, conditions.seeing_arcsec) == 0:
            raise ValueError("by the residual law of the instrument's profile there is no AO residual")
        return cls(
            conditions.band, conditions.residual_law, conditions.seeing_arcsec, conditions.seeing_measured
        )

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`: it keeps numbers per wavelength, so each band has its own."""
        return self if here.settings.spectrum == first.settings.spectrum else SeeingHalo.under(here)

    def handed_on(self, values: np.ndarray, now: Conditions, then: Calibrated) -> FixedEffect:
        """See `Effect.handed_on`: the residual inside the band follows the seeing."""
        now_nm, then_nm = (in_band_wfe_nm(self.band, self.law, one.seeing_arcsec) for one in (now, then))
        variance, *shape = values
        return FixedEffect(self, [variance * (now_nm / then_nm) ** 2, *shape])

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`."""
        return f"an AO residual of {public['wfe_nm']:.0f} nm RMS"

    def exponent(self, values: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """``½ (2π/λ)² D(b)`` at `values` on `grid`, D in nm²."""
        on = self._on(grid)
        structure = on.in_band.structure_nm2(*values) + self._beyond(values[0]) * on.fitting_nm2
        return 0.5 * (2 * np.pi * NM / grid.wavelengths_m) ** 2 * structure[on.place]

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`."""
        return factor * torch.exp(-self.exponent(values, grid))

    def slopes(
        self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """See `OtfEffect.slopes`."""
        on = self._on(grid)
        structure, slopes = on.in_band.structure_and_slopes(*values)
        slopes[0] += self._per_nm2 * on.fitting_nm2
        structure = structure + self._beyond(values[0]) * on.fitting_nm2
        scale = -0.5 * (2 * np.pi * NM / grid.wavelengths_m) ** 2
        with_halo = scale * factor * torch.exp(scale * structure[on.place])
        return [with_halo * slopes[index][on.place] for index in wanted]

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """In-band WFE, total WFE, PSD slope, strength and direction of the elongation, four-fold strength."""
        variance, slope, cos2, sin2, cos4, sin4 = (float(v) for v in values)
        return {
            "wfe_nm": float(np.sqrt(max(variance + self._beyond(variance) * self.fitting_nm2, 0.0))),
            "in_band_wfe_nm": float(np.sqrt(max(variance, 0.0))),
            "slope": slope,
            "stretch": float(np.hypot(cos2, sin2)),
            "stretch_angle_deg": float(np.rad2deg(np.arctan2(sin2, cos2)) / 2 % 180),
            "cross": float(np.hypot(cos4, sin4)),
        }

    def values_of(self, wfe_nm: float | None = None, scale: float | None = None) -> list[float]:
        """See `Effect.values_of`: the total residual is given, its shape is as expected.

        Raises
        ------
        ValueError
            Unless exactly one of the two is given.
        """
        if wfe_nm is not None and scale is None:
            total_nm2 = wfe_nm**2
        elif scale is not None and wfe_nm is None:
            total_nm2 = scale**2 * self.expected_nm2
        else:
            raise ValueError("seeing_halo is fixed by either wfe_nm or scale")
        in_band, *shape = (p.start for p in self.parameters)
        if self.measured:
            return [max(total_nm2 - self.fitting_nm2, 0.0), *shape]
        return [total_nm2 * in_band / self.expected_nm2, *shape]

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[Effect]:
        """See `Effect.candidates`: the whole halo scaled, as there is no turbulence without the effect."""
        return [ScaledHalo(self)]

    def _beyond(self, variance_nm2):
        """Turbulence beyond the cut-off, of what the seeing gives."""
        return self._fixed + self._per_nm2 * variance_nm2

    def _on(self, grid: OtfGrid) -> _Baselines:
        return _baselines(self.band, self.r0_m, grid.focal)


@dataclass(frozen=True)
class _Baselines:
    """What depends on the baselines only.

    Attributes
    ----------
    in_band : InBandResidual
        On the baselines within the pupil.
    fitting_nm2 : tensor, (baselines,)
        Structure function beyond the cut-off.
    place : tensor of int, (p, p//2 + 1)
        Of every baseline of the grid among these.
    """

    in_band: InBandResidual
    fitting_nm2: torch.Tensor
    place: torch.Tensor


@lru_cache(maxsize=4)
def _baselines(band: ResidualBand, r0_m: float, focal: FocalGrid) -> _Baselines:
    bx, by = np.broadcast_arrays(focal.baseline_x_m[None, :], focal.baseline_y_m[:, None])
    lengths = np.hypot(bx, by)
    within = lengths <= focal.longest_m
    return _Baselines(
        InBandResidual(bx[within], by[within], band),
        torch.as_tensor(fitting_structure_nm2(lengths[within], band, r0_m)),
        torch.as_tensor(np.where(within, np.cumsum(within).reshape(within.shape) - 1, 0)),
    )


class ScaledHalo(OtfEffect):
    """The halo expected at the seeing with another variance, 0 without and 1 with it: for searches.

    Parameters
    ----------
    halo : SeeingHalo
        What it stands for; a fit then goes on with this.
    """

    name, public, speckles = SeeingHalo.name, SeeingHalo.public, True
    belongs_to = SeeingHalo.belongs_to
    look_alike = SeeingHalo.look_alike
    parameters = (Parameter("share", "of the variance", 1.0, lower=0.0, upper=100.0, plausible=(0.0, 10.0)),)

    def __init__(self, halo: SeeingHalo):
        self.halo = halo

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`."""
        same = here.settings.spectrum == first.settings.spectrum
        return self if same else ScaledHalo(SeeingHalo.under(here))

    def whole(self, start: FixedEffect, sizes: np.ndarray) -> FixedEffect:
        """See `Effect.whole`: the halo with its shape free, if there is enough of it."""
        if sizes[0] < FULL_HALO:
            return start
        parameters = self.halo.parameters
        return FixedEffect(self.halo, [p.start for p in parameters], [p.name for p in parameters])

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`."""
        return self.halo.phrase(public)

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`."""
        expected = torch.tensor([p.start for p in self.halo.parameters], dtype=torch.float64)
        return factor * torch.exp(-values[0] * self.halo.exponent(expected, grid))

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Total WFE."""
        return {"wfe_nm": float(np.sqrt(max(values[0], 0.0) * self.halo.expected_nm2))}
