"""`seeing_halo`: the long-exposure OTF of the AO residual, ``exp(-½ (2π/λ)² D(b))``.

The structure function D is that of the residual inside the correction band (a power law with free variance,
slope, two-fold and four-fold anisotropy, and aliased turbulence of free variance; variances, because ∂μ/∂σ
vanishes at σ = 0) plus that of the von Kármán turbulence beyond it. The light of the latter falls mostly
outside a window of 0.6", where it cannot be distinguished from flux and background: the seeing fixes it, and
where that was not measured, the residual in the band.

The residual has neither tip nor tilt, which go into the image motion. As these go with coma in turbulence,
what is left is an image that moves as its coma changes: the OTF between x and x + b has a further factor
``exp(u)``, with ``u = (2π/λ)² Σ_k (b·<a c_k>) [ψ_k(x + b) - ψ_k(x)]`` for the comas ψ_k along both axes; see
`optics.in_band_residual`. With its mean m and variance v over all x this is about
``exp(m + v/2) (1 + u - m)``, and the part with u is ``Σ_k i (2π/λ) (b·<a c_k>) FFT(∂I/∂c_k)``. Where the
residual is strong and steep, it is some per cent of the image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Calibrated, Conditions, Parameter, direction, number
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.optics.grids import OtfGrid, PupilMode
from irlos_pipe.optics.residual_otf import COMA, MeanFactor, ResidualOtf, residual_otf
from irlos_pipe.optics.structure_function import (
    ResidualBand,
    fitting_variance_nm2,
    seeing_to_r0_m,
)

VARIANCES = (0, 6)  # places of the two variances among the parameters
FULL_HALO = 0.1  # share of the expected variance from which the shape of the halo is fitted as well


def in_band_wfe_nm(band: ResidualBand, law: ResidualLaw, seeing_arcsec: float) -> float:
    """Return the residual inside the correction `band` [nm RMS] that the `law` expects at `seeing_arcsec`."""
    total = law.wfe_nm(seeing_arcsec)
    fitting = fitting_variance_nm2(band, seeing_to_r0_m(seeing_arcsec))
    return float(np.sqrt(max(total**2 - fitting, (0.3 * total) ** 2)))


def require_residual(conditions: Conditions) -> None:
    """Raise ValueError where the profile of the instrument states no AO residual: on a bench."""
    if not in_band_wfe_nm(conditions.band, conditions.residual_law, conditions.seeing_arcsec) > 0:
        raise ValueError("by the residual law of the instrument's profile there is no AO residual")


class SeeingHalo(OtfEffect):
    """Averaged speckle and halo of the residual wavefront.

    Parameters
    ----------
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
        "T(b) = exp(−½ (2π/λ)² D(b)); D: structure function of the residual OPD without tip and tilt, its "
        "in-band variance and shape fitted; the image moves with the coma of the residual"
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
        number("aliasing", "part of the variance inside the band"),
    )
    speckles = True
    look_alike = "tip_tilt_jitter, which broadens the core instead of feeding a halo"
    reference = (
        "Fétick et al. 2019, A&A 628, A99; Roddier 1981, Prog. Opt. 19, 281; "
        "Rigaut et al. 1998, Proc. SPIE 3353, 1038; Noll 1976, J. Opt. Soc. Am. 66, 207"
    )

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
            Parameter("aliasing_nm2", "nm²", 0.0, 0.0, expected, 0.0, 1e6, None, (0.0, 400.0**2)),
        )

    @classmethod
    def under(cls, conditions: Conditions) -> SeeingHalo:
        """See `Effect.under`: it means nothing on a bench without atmosphere."""
        require_residual(conditions)
        return cls(
            conditions.band, conditions.residual_law, conditions.seeing_arcsec, conditions.seeing_measured
        )

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`: it keeps numbers per wavelength, so each band has its own."""
        return self if here.settings.spectrum == first.settings.spectrum else SeeingHalo.under(here)

    def handed_on(self, values: np.ndarray, now: Conditions, then: Calibrated) -> FixedEffect:
        """See `Effect.handed_on`: the residual inside the band follows the seeing."""
        now_nm, then_nm = (in_band_wfe_nm(self.band, self.law, one.seeing_arcsec) for one in (now, then))
        variance, *shape, aliasing = values
        stronger = (now_nm / then_nm) ** 2
        return FixedEffect(self, [variance * stronger, *shape, aliasing * stronger])

    @property
    def further_paths(self) -> Sequence[tuple[PupilMode | None, Effect]]:
        """See `Effect.further_paths`: motion that goes with coma."""
        return [(PupilMode(noll), _MovesWithComa(self, noll)) for noll in COMA]

    def phrase(self, public: Mapping[str, Any]) -> str:
        return f"an AO residual of {public['wfe_nm']:.0f} nm RMS"

    def exponent(self, values: Tensor, grid: OtfGrid) -> Tensor:
        """``½ (2π/λ)² D(b)`` at `values` on `grid`, D in nm²."""
        return self.on(grid).exponent(values, self._beyond(values), grid)

    def mean_factor(self, values: Tensor, grid: OtfGrid) -> MeanFactor:
        """Return the mean of the OTF factor over the pupil at `values` on `grid`."""
        return self.on(grid).mean_factor(values, self._beyond(values), grid)

    def rates(self, values: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[MeanFactor]:
        """Return the derivatives of `mean_factor` at `values` on `grid` by the parameters `wanted`."""
        by_beyond = {index: self._per_nm2 * (index in VARIANCES) for index in wanted}
        return self.on(grid).rates(values, by_beyond, grid)

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        log, mean = self.mean_factor(values, grid)
        return factor * torch.exp(log) * (1 - mean)

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        log, mean = self.mean_factor(values, grid)
        light = factor * torch.exp(log)
        return [light * (rate.log * (1 - mean) - rate.mean) for rate in self.rates(values, grid, wanted)]

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Total and in-band WFE, slope of the PSD, two-fold and four-fold strength, share of aliasing."""
        variance, slope, cos2, sin2, cos4, sin4, aliasing = (float(v) for v in values)
        in_band = max(variance + aliasing, 0.0)
        return {
            "wfe_nm": float(np.sqrt(in_band + self._beyond(values) * self.fitting_nm2)),
            "in_band_wfe_nm": float(np.sqrt(in_band)),
            "slope": slope,
            "stretch": float(np.hypot(cos2, sin2)),
            "stretch_angle_deg": float(np.rad2deg(np.arctan2(sin2, cos2)) / 2 % 180),
            "cross": float(np.hypot(cos4, sin4)),
            "aliasing": aliasing / in_band if in_band > 0 else 0.0,
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

    def _beyond(self, values):
        """Turbulence beyond the cut-off, of what the seeing gives."""
        return self._fixed + self._per_nm2 * (values[VARIANCES[0]] + values[VARIANCES[1]])

    def on(self, grid: OtfGrid) -> ResidualOtf:
        """Return the residual on the baselines of `grid`."""
        return residual_otf(self.band, self.r0_m, grid.focal)


class _MovesWithComa(OtfEffect):
    """The factor ``exp(m + v/2 - ½ (2π/λ)² D) i (2π/λ) b·<a c>`` of the derivative by the coma on one axis.

    The coma c is `noll`; the parameters are those of the `halo`.
    """

    name = SeeingHalo.name

    def __init__(self, halo: SeeingHalo, noll: int):
        self.halo, self.noll, self.parameters = halo, noll, halo.parameters

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        moving = self.halo.on(grid).moving(values, self.noll, grid)
        return factor * torch.exp(self.halo.mean_factor(values, grid).log) * moving

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        on, light = self.halo.on(grid), factor * torch.exp(self.halo.mean_factor(values, grid).log)
        moving, changes = on.moving(values, self.noll, grid), on.moving_rates(values, self.noll, grid)
        pairs = zip(wanted, self.halo.rates(values, grid, wanted), strict=True)
        return [light * (changes[index] + rate.log * moving) for index, rate in pairs]


class ScaledHalo(OtfEffect):
    """The halo expected at the seeing with another variance, 0 without and 1 with it: for searches.

    It stands for the `halo`, with which a fit then goes on.
    """

    name, public, speckles = SeeingHalo.name, SeeingHalo.public, True
    belongs_to = SeeingHalo.belongs_to
    look_alike = SeeingHalo.look_alike
    parameters = (Parameter("share", "of the variance", 1.0, lower=0.0, upper=100.0, plausible=(0.0, 10.0)),)

    def __init__(self, halo: SeeingHalo):
        self.halo = halo

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        same = here.settings.spectrum == first.settings.spectrum
        return self if same else ScaledHalo(SeeingHalo.under(here))

    def whole(self, start: FixedEffect, sizes: np.ndarray) -> FixedEffect:
        """See `Effect.whole`: the halo with its shape free, if there is enough of it."""
        if sizes[0] < FULL_HALO:
            return start
        parameters = self.halo.parameters
        return FixedEffect(self.halo, [p.start for p in parameters], [p.name for p in parameters])

    def phrase(self, public: Mapping[str, Any]) -> str:
        return self.halo.phrase(public)

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        expected = torch.tensor([p.start for p in self.halo.parameters], dtype=torch.float64)
        return factor * torch.exp(-values[0] * self.halo.exponent(expected, grid))

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """Total WFE."""
        return {"wfe_nm": float(np.sqrt(max(values[0], 0.0) * self.halo.expected_nm2))}
