"""Effects of colours and scale: `spectrum`, `atmospheric_dispersion`, `plate_scale` and `anamorphism`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.simulate.distortion import stretch
from irlos_pipe.simulate.effects.base import LightEffect, RecordingSetup, own, wider
from irlos_pipe.simulate.light import Band, Ray, mean_centre_nm


@dataclass(frozen=True)
class Spectrum(LightEffect):
    """The true spectrum differs from the declared one.

    Attributes
    ----------
    wavelength_nm : float, optional
        True centre, the photon-weighted mean of the bands' centres; all bands are shifted alike.
    slope : float
        Relative change of the photons per µm about the mean wavelength.
    weights : sequence of float, optional
        Factor on the photons of each band.
    """

    name = "spectrum"
    wavelength_nm: float | None = wider(500.0, 5000.0, None)
    slope: float = wider(-20.0, 20.0, 0.0)
    weights: Sequence[float] | None = own("factor on the photons of each band", 0.0, 1000.0)

    def misfit(self, setup: RecordingSetup) -> str:
        """See `SimulatedEffect.misfit`."""
        if self.weights is None or len(self.weights) == setup.bands:
            return ""
        return f"effects.spectrum.weights has {len(self.weights)} factors; give one per band, {setup.bands}"

    def spectrum(
        self, wavelengths_nm: np.ndarray, weights: np.ndarray, bands: Sequence[Band]
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `LightEffect.spectrum`."""
        factors = np.ones(len(bands)) if self.weights is None else np.asarray(self.weights, float)
        changed = weights * np.repeat(factors, len(weights) // len(bands))
        mean_nm = np.average(wavelengths_nm, weights=changed)
        changed = changed * np.maximum(1 + self.slope * (wavelengths_nm - mean_nm) / 1000, 0.0)
        shift_nm = 0.0 if self.wavelength_nm is None else self.wavelength_nm - mean_centre_nm(bands)
        return wavelengths_nm + shift_nm, changed


@dataclass(frozen=True)
class AtmosphericDispersion(LightEffect):
    """Refraction displaces colours, by `mas_per_um` at the mean wavelength, towards `angle_deg`."""

    name = "atmospheric_dispersion"
    mas_per_um: float = wider(-5000.0, 5000.0)
    angle_deg: float = 0.0

    def rays(self, rays: list[Ray]) -> list[Ray]:
        """See `LightEffect.rays`."""
        mean_nm = np.average([ray.wavelength_nm for ray in rays], weights=[ray.weight for ray in rays])
        step_um = 1e-4
        slope = (
            (_refractivity(mean_nm / 1e3 + step_um) - _refractivity(mean_nm / 1e3 - step_um)) / 2 / step_um
        )
        mas = self.mas_per_um / slope
        return [
            ray.moved(
                mas * (_refractivity(ray.wavelength_nm / 1e3) - _refractivity(mean_nm / 1e3)), self.angle_deg
            )
            for ray in rays
        ]


def _refractivity(wavelength_um: float) -> float:
    """n − 1 of standard air, 15 °C and 1013.25 hPa (Peck & Reeder 1972, J. Opt. Soc. Am. 62, 958)."""
    wavenumber2 = wavelength_um**-2
    terms = 8060.51 + 2_480_990 / (132.274 - wavenumber2) + 17_455.7 / (39.32957 - wavenumber2)
    return 1e-8 * terms


@dataclass(frozen=True)
class PlateScale(LightEffect):
    """The pixels are larger on the sky than declared, by a `fraction`."""

    name = "plate_scale"
    fraction: float = wider(-1.0, 1.0)

    def pixel_scale_mas(self, assumed_mas: float) -> float:
        """See `LightEffect.pixel_scale_mas`."""
        return assumed_mas * (1 + self.fraction)


@dataclass(frozen=True)
class Anamorphism(LightEffect):
    """The image is larger along `angle_deg` than across, by a `fraction`; its area stays."""

    name = "anamorphism"
    fraction: float = wider(0.0, 0.5)
    angle_deg: float = 0.0

    def stretch(self) -> np.ndarray:
        """See `LightEffect.stretch`."""
        return stretch(self.fraction, self.angle_deg)
