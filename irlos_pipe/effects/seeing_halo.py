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

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.units import NM
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Calibrated, Conditions, Parameter, direction, number
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.optics.coma_between import coma_between
from irlos_pipe.optics.fourier_matrices import FocalGrid
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.in_band_residual import InBandResidual, Residual
from irlos_pipe.optics.structure_function import (
    ResidualBand,
    fitting_structure_nm2,
    fitting_variance_nm2,
    seeing_to_r0_m,
)

COMA = 7, 8  # Noll, along y and along x
VARIANCES = (0, 6)  # places of the two variances among the parameters
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
            Parameter("aliasing_nm2", "nm²", 0.0, 0.0, expected, 0.0, 1e6, None, (0.0, 400.0**2)),
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
        variance, *shape, aliasing = values
        stronger = (now_nm / then_nm) ** 2
        return FixedEffect(self, [variance * stronger, *shape, aliasing * stronger])

    @property
    def by_mode(self) -> Sequence[tuple[int, Effect]]:
        """See `Effect.by_mode`: motion that goes with coma."""
        return [(noll, _MovesWithComa(self, noll)) for noll in COMA]

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`."""
        return f"an AO residual of {public['wfe_nm']:.0f} nm RMS"

    def exponent(self, values: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """``½ (2π/λ)² D(b)`` at `values` on `grid`, D in nm²."""
        on = self.on(grid)
        structure = on.residual(values).structure + self._beyond(values) * on.fitting_nm2
        return 0.5 * _per_nm2(grid) * structure[on.place]

    def mean_factor(self, values: torch.Tensor, grid: OtfGrid) -> _MeanFactor:
        """Return the mean of the OTF factor over the pupil, of a flat wavefront, at `values` on `grid`."""
        mean, variance = self.on(grid).moves(self.on(grid).residual(values).tilt_with_coma, grid)
        return _MeanFactor(mean + variance / 2 - self.exponent(values, grid), mean)

    def rates(self, values: torch.Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[_MeanFactor]:
        """Return the derivatives of `mean_factor`."""
        on, (residual, slopes) = self.on(grid), self.on(grid).with_slopes(values)
        found = []
        for index in wanted:
            mean, variance = on.moves_change(residual.tilt_with_coma, slopes.tilt_with_coma[index], grid)
            structure = slopes.structure[index] + self._per_nm2 * (index in VARIANCES) * on.fitting_nm2
            found.append(_MeanFactor(mean + variance / 2 - 0.5 * _per_nm2(grid) * structure[on.place], mean))
        return found

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`."""
        log, mean = self.mean_factor(values, grid)
        return factor * torch.exp(log) * (1 - mean)

    def slopes(
        self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """See `OtfEffect.slopes`."""
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

    def on(self, grid: OtfGrid) -> _Baselines:
        """Return what of the residual depends on the baselines of `grid`."""
        return _baselines(self.band, self.r0_m, grid.focal)


class _MeanFactor(NamedTuple):
    """OTF factor of the residual with the mean motion that goes with coma, or its derivatives.

    Attributes
    ----------
    log : tensor, (wavelengths, p, p//2 + 1)
        Logarithm of the factor: ``m + v/2 - ½ (2π/λ)² D``.
    mean : tensor, (wavelengths, p, p//2 + 1)
        The m in it.
    """

    log: torch.Tensor
    mean: torch.Tensor


class _MovesWithComa(OtfEffect):
    """The factor ``exp(m + v/2 - ½ (2π/λ)² D) i (2π/λ) b·<a c>`` of the derivative by the coma on one axis.

    Parameters
    ----------
    halo : SeeingHalo
        With the same parameters.
    noll : int
        Of the coma c.
    """

    name = SeeingHalo.name

    def __init__(self, halo: SeeingHalo, noll: int):
        self.halo, self.parameters = halo, halo.parameters
        y, x = COMA
        self._tilts = {x: slice(0, 2), y: slice(1, 3)}[noll]  # covariances with those along x and y

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`."""
        light = factor * torch.exp(self.halo.mean_factor(values, grid).log)
        return light * self._moving(self.halo.on(grid).residual(values).tilt_with_coma, grid)

    def slopes(
        self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """See `OtfEffect.slopes`."""
        residual, slopes = self.halo.on(grid).with_slopes(values)
        light = factor * torch.exp(self.halo.mean_factor(values, grid).log)
        moving = self._moving(residual.tilt_with_coma, grid)
        changes = [self._moving(slopes.tilt_with_coma[index], grid) for index in wanted]
        rates = self.halo.rates(values, grid, wanted)
        return [light * (change + rate.log * moving) for change, rate in zip(changes, rates, strict=True)]

    def _moving(self, with_coma: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """Phase per coma [1/nm], (wavelengths, p, p//2 + 1), that goes with it at these covariances."""
        return 1j * _per_nm2(grid).sqrt() * grid.path_m(*with_coma[self._tilts])


class _Baselines:
    """The residual on one set of baselines.

    Parameters
    ----------
    band : ResidualBand
    r0_m : float
    focal : FocalGrid

    Attributes
    ----------
    fitting_nm2 : tensor, (baselines,)
        Structure function beyond the cut-off, on the baselines within the pupil.
    place : tensor of int, (p, p//2 + 1)
        Of every baseline of the grid among these.
    """

    def __init__(self, band: ResidualBand, r0_m: float, focal: FocalGrid):
        bx, by = np.broadcast_arrays(focal.baseline_x_m[None, :], focal.baseline_y_m[:, None])
        lengths = np.hypot(bx, by)
        within = lengths <= focal.longest_m
        self.fitting_nm2 = torch.as_tensor(fitting_structure_nm2(lengths[within], band, r0_m))
        self.place = torch.as_tensor(np.where(within, np.cumsum(within).reshape(within.shape) - 1, 0))
        bx, by = bx[within], by[within]
        self._in_band = InBandResidual(bx, by, band)
        self._coma = [torch.as_tensor(one) for one in coma_between(lengths[within], 1 / band.low_per_m)]
        b = np.maximum(lengths[within], 1e-9)
        self._along = torch.as_tensor(np.stack([bx * bx, 2 * bx * by, by * by]) / b)
        self._across = torch.as_tensor(np.stack([-bx * by, bx * bx - by * by, bx * by]) / b)
        self._last: dict[tuple[str, tuple[float, ...]], Any] = {}

    def residual(self, values: torch.Tensor) -> Residual:
        """Return that inside the band at the parameters `values` of the effect."""
        if values.requires_grad:
            return self._in_band.at(*values)
        return self._kept("at", values, lambda: self._in_band.at(*values))

    def with_slopes(self, values: torch.Tensor) -> tuple[Residual, Residual]:
        """Return the same and its derivatives."""
        return self._kept("slopes", values, lambda: self._in_band.with_slopes(values))

    def moves(self, with_coma: torch.Tensor, grid: OtfGrid) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and variance of u, (wavelengths, p, p//2 + 1) each, at covariances of tilt and coma."""
        mean, along, across = self._coma
        lengthwise, crosswise = with_coma @ self._along, with_coma @ self._across
        variance = along * lengthwise**2 + across * crosswise**2
        per_nm2 = _per_nm2(grid)
        return per_nm2 * (mean * lengthwise)[self.place], per_nm2**2 * variance[self.place]

    def moves_change(
        self, with_coma: torch.Tensor, change: torch.Tensor, grid: OtfGrid
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return how both change with the covariances."""
        mean, along, across = self._coma
        lengthwise, crosswise = change @ self._along, change @ self._across
        variance = along * (with_coma @ self._along) * lengthwise
        variance = 2 * (variance + across * (with_coma @ self._across) * crosswise)
        per_nm2 = _per_nm2(grid)
        return per_nm2 * (mean * lengthwise)[self.place], per_nm2**2 * variance[self.place]

    def _kept(self, what: str, values: torch.Tensor, compute: Callable[[], Any]) -> Any:
        """What was computed last, if it was for these `values`: star and modes ask for the same."""
        key = what, tuple(values.tolist())
        kept = self._last.get(key)
        if kept is None:
            self._last = {one: value for one, value in self._last.items() if one[1] == key[1]}
            kept = self._last[key] = compute()
        return kept


def _per_nm2(grid: OtfGrid) -> torch.Tensor:
    """``(2π/λ)²`` [rad²/nm²], (wavelengths, 1, 1)."""
    return (2 * np.pi * NM / grid.wavelengths_m) ** 2


@lru_cache(maxsize=4)
def _baselines(band: ResidualBand, r0_m: float, focal: FocalGrid) -> _Baselines:
    return _Baselines(band, r0_m, focal)


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
