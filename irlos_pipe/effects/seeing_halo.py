"""`seeing_halo`: the long-exposure OTF of the AO residual, ``exp(-½ (2π/λ)² D(b))``.

The structure function D is that of the residual inside the correction band (a power law with free variance,
slope, two-fold and four-fold anisotropy, and aliased turbulence of free variance; variances, because ∂μ/∂σ
vanishes at σ = 0) plus that of the von Kármán turbulence beyond it. The light of the latter falls mostly
outside a window of 0.6", where it cannot be distinguished from flux and background: the seeing fixes it, and
where that was not measured, the residual in the band.

The residual has neither tip nor tilt, which go into the image motion. As these go with coma in turbulence,
what is left is an image that moves as its coma changes: the OTF between x and x + b has a further factor
``exp(u)``, with ``u = (2π/λ)² Σ_k (b·<a c_k>) [ψ_k(x + b) - ψ_k(x)]`` for the comas ψ_k along both axes; see
`optics.structure_function`. With its mean m and variance v over all x this is about
``exp(m + v/2) (1 + u - m)``, and the part with u is ``Σ_k i (2π/λ) (b·<a c_k>) FFT(∂I/∂c_k)``. Where the
residual is strong and steep, it is some per cent of the image.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import scipy

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.units import MAS, NM
from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Calibrated, Conditions, Parameter, Public, direction
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.optics.fourier_matrices import FocalGrid
from irlos_pipe.optics.grids import OtfGrid, PupilMode
from irlos_pipe.optics.residual_otf import COMA, MeanFactor, ResidualOtf, per_nm2, residual_otf
from irlos_pipe.optics.structure_function import (
    ResidualBand,
    fitting_variance_nm2,
    seeing_to_r0_m,
    von_karman_nm2,
)

VARIANCES = (0, 6)  # places of the two variances among the parameters
FULL_HALO = 0.1  # share of the expected variance from which the shape of the halo is fitted as well

NODES = 24  # of the quadrature between the two cut-offs
OFF = 0.2  # σ of the prior, as a fraction of the declared cut-off
FARTHEST = 2.0  # largest factor from the declared cut-off that a fit may reach, either way
NOLLS = {"edge": 4, "side_x": 2, "side_y": 3}
LARGEST = 0.55  # nowhere less variance than none: Noll 4 is -√3 at the centre


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

    Parameters: `law`, AO residual against seeing; `seeing_arcsec`, which sets the turbulence beyond the
    cut-off, and the in-band residual to start from; whether it was `measured`: otherwise the turbulence
    beyond the cut-off grows and falls with the in-band variance, in the proportion that the seeing gives.
    """

    name = "seeing_halo"
    formula = (
        "T(b) = exp(−½ (2π/λ)² D(b)); D: structure function of the residual OPD without tip and tilt, its "
        "in-band variance and shape fitted; the image moves with the coma of the residual"
    )
    belongs_to = "moment"
    usual = True
    public = (
        Public("wfe_nm", "nm RMS in all", 0.0, 1000.0, required=False),
        Public("scale", "of the WFE expected at the seeing", 0.0, 10.0, required=False),
    )
    derived = (
        Public("in_band_wfe_nm", "nm RMS inside the correction band"),
        Public("slope", "exponent of the spectrum inside the band"),
        Public("stretch", "two-fold anisotropy"),
        direction("stretch_angle_deg"),
        Public("cross", "four-fold anisotropy"),
        Public("aliasing", "part of the variance inside the band"),
    )
    speckles = True
    look_alike = "tip_tilt_jitter, which broadens the core instead of feeding a halo"
    reference = (
        "Fétick et al. 2019, A&A 628, A99; Roddier 1981, Prog. Opt. 19, 281; "
        "Rigaut et al. 1998, Proc. SPIE 3353, 1038; Noll 1976, J. Opt. Soc. Am. 66, 207"
    )

    def __init__(self, band: ResidualBand, law: ResidualLaw, seeing_arcsec: float, measured: bool = True):
        self.band, self.law, self.seeing_arcsec, self.measured = band, law, seeing_arcsec, measured
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
    def under(cls, conditions: Conditions) -> "SeeingHalo":
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

        Raises `ValueError` unless exactly one of the two is given.
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
        return {"wfe_nm": float(np.sqrt(max(values[0], 0.0) * self.halo.expected_nm2))}


class AoCutoff(OtfEffect):
    """The correction of the AO ends at another spatial frequency than declared, and the halo begins there.

    Between the two cut-offs there is turbulence in place of what the AO is expected to leave inside its band,
    or the reverse. Elsewhere the residual is that of `seeing_halo`.

    It is looked for where the image shows the edge of the corrected field, λ times the cut-off from the star.
    Errors do not hold how far the residual inside the band is from the expected one: some per cent.

    Parameters: `band` with the cut-off as declared, `law`, AO residual against seeing.
    """

    name = "ao_cutoff"
    formula = (
        "T(b) = exp(−½ (2π/λ)² (D(b; cut-off) − D(b; cut-off as declared))); D: turbulence beyond the "
        "cut-off, a residual as f^−2 inside"
    )
    fact = True
    public = (Public("per_m", "1/m, the cut-off, not its change", 1e-3, 1e6),)
    sentence = "a correction that ends at {per_m:.3f} cycles per metre"
    look_alike = "seeing_halo, which has no edge; without one in the window, flux and background"
    reference = "Fétick et al. 2019, A&A 628, A99"

    def __init__(self, band: ResidualBand, law: ResidualLaw, seeing_arcsec: float):
        declared = band.cutoff_per_m
        self.band, self.r0_m = band, seeing_to_r0_m(seeing_arcsec)
        in_band_nm2 = in_band_wfe_nm(band, law, seeing_arcsec) ** 2
        self._in_band_nm2 = in_band_nm2 / (2 * np.pi * np.log(declared / band.low_per_m))  # times f^-2
        near, far = declared / FARTHEST, declared * FARTHEST
        lowest, sigma = max(near, band.low_per_m), OFF * declared
        self.parameters = (
            Parameter("per_m", "1/m", declared, declared, sigma, lowest, far, declared, (near, far)),
        )

    @classmethod
    def under(cls, conditions: Conditions) -> "AoCutoff":
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


class UnevenResidual(OtfEffect):
    """The AO residual is stronger at the edge of the pupil, or on one side of it.

    Values are those of Noll 4, 2 and 3 in the variance of the residual inside the correction band, as parts
    of the variance that is expected at the seeing.

    Parameters: `law`, AO residual against seeing.
    """

    name = "uneven_residual"
    formula = "D(x, x + b) = D(b) + ½ [g(x) + g(x + b)] D_in(b); g = edge Z_4 + side_x Z_2 + side_y Z_3"
    belongs_to = "moment"
    public = tuple(
        Public(name, f"of the variance, Noll {noll}", -LARGEST, LARGEST, required=False)
        for name, noll in NOLLS.items()
    )
    parameters = tuple(
        Parameter(name, "", 0.0, 0.0, 0.2, -LARGEST, LARGEST, plausible=(-LARGEST, LARGEST)) for name in NOLLS
    )
    look_alike = "amplitude_aberration, which takes light away for good; the residual's goes to the halo"
    reference = "Véran et al. 1997, JOSA A 14, 3057; Fried & Belsher 1994, JOSA A 11, 277 (cone effect)"

    def __init__(self, band: ResidualBand, law: ResidualLaw, seeing_arcsec: float):
        self._residual = band, law, seeing_arcsec

    @classmethod
    def under(cls, conditions: Conditions) -> "UnevenResidual":
        require_residual(conditions)
        return cls(conditions.band, conditions.residual_law, conditions.seeing_arcsec)

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`: parts of what is expected here."""
        return UnevenResidual.under(here)

    @property
    def further_paths(self) -> Sequence[tuple[PupilMode | None, Effect]]:
        return [(PupilMode(noll, of_amplitude=True), _Part(self, i)) for i, noll in enumerate(NOLLS.values())]

    def phrase(self, public: Mapping[str, Any]) -> str:
        edge, side = public["edge"], float(np.hypot(public["side_x"], public["side_y"]))
        where = "at the edge" if edge > 0 else "in the middle"
        return (
            f"an AO residual that is stronger {where} of the pupil ({abs(edge):.0%} RMS of its variance), "
            f"and by {side:.0%} on one side"
        )

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        """See `OtfEffect.apply`: all of it is in `further_paths`."""
        return factor

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        return [torch.zeros_like(factor)] * len(wanted)

    def share(self, grid: OtfGrid) -> Tensor:
        """Return ``-½ ½ (2π/λ)² D_in(b)``, (wavelengths, p, p//2 + 1)."""
        return -0.25 * per_nm2(grid) * _in_band_nm2(*self._residual, grid.focal)


class _Part(OtfEffect):
    """The factor of the derivative by the mode at a `place` in `uneven`, whose parameters it has."""

    name = UnevenResidual.name

    def __init__(self, uneven: UnevenResidual, place: int):
        self.uneven, self.place, self.parameters = uneven, place, uneven.parameters

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        return factor * values[self.place] * self.uneven.share(grid)

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        own = factor * self.uneven.share(grid)
        return [own if index == self.place else torch.zeros_like(own) for index in wanted]


@lru_cache(maxsize=4)
def _in_band_nm2(band: ResidualBand, law: ResidualLaw, seeing_arcsec: float, focal: FocalGrid) -> Tensor:
    """Structure function inside the band that is expected at the seeing, (p, p//2 + 1) [nm²]."""
    halo = SeeingHalo(band, law, seeing_arcsec)
    expected = torch.tensor([p.start for p in halo.parameters], dtype=torch.float64)
    return residual_otf(band, halo.r0_m, focal).structure_nm2(expected, 0.0)
