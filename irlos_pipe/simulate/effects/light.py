"""Effects on the light that arrives: colours, scale, a companion, ghosts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from irlos_pipe.conventions.keys import key
from irlos_pipe.simulate.effects.base import SimulatedEffect
from irlos_pipe.simulate.light import Band, Ray, mean_centre_nm

GHOST_NODES = 6  # nodes per axis of the Gauss–Hermite rule for the blur of a ghost


@dataclass(frozen=True)
class Spectrum(SimulatedEffect):
    """The true spectrum differs from the declared one."""

    name = "spectrum"
    # true centre, the photon-weighted mean of the bands' centres; all bands are shifted by the same
    wavelength_nm: float | None = key(None, ge=500.0, le=5000.0)
    # relative change of the photons per µm about the mean wavelength
    slope: float = key(0.0, ge=-20.0, le=20.0)
    # factor on the photons of each band
    weights: Sequence[float] | None = key(None, "factor on the photons of each band", ge=0.0, le=1000.0)

    def misfit(self, scene: Any) -> str:
        if self.weights is None or len(self.weights) == len(scene.bands):
            return ""
        return (
            f"effects.spectrum.weights has {len(self.weights)} factors; give one per band, {len(scene.bands)}"
        )

    def spectrum(
        self, wavelengths_nm: np.ndarray, weights: np.ndarray, bands: Sequence[Band]
    ) -> tuple[np.ndarray, np.ndarray]:
        factors = np.ones(len(bands)) if self.weights is None else np.asarray(self.weights, float)
        changed = weights * np.repeat(factors, len(weights) // len(bands))
        mean_nm = np.average(wavelengths_nm, weights=changed)
        changed = changed * np.maximum(1 + self.slope * (wavelengths_nm - mean_nm) / 1000, 0.0)
        shift_nm = 0.0 if self.wavelength_nm is None else self.wavelength_nm - mean_centre_nm(bands)
        return wavelengths_nm + shift_nm, changed


@dataclass(frozen=True)
class AtmosphericDispersion(SimulatedEffect):
    """Refraction displaces colours, by `mas_per_um` at the mean wavelength, towards `angle_deg`."""

    name = "atmospheric_dispersion"
    mas_per_um: float = key(ge=-5000.0, le=5000.0)
    angle_deg: float = 0.0

    def rays(self, rays: list[Ray]) -> list[Ray]:
        mean_um = np.average([ray.wavelength_nm for ray in rays], weights=[ray.weight for ray in rays]) / 1e3
        step_um = 1e-4
        slope = (_refractivity(mean_um + step_um) - _refractivity(mean_um - step_um)) / 2 / step_um
        mas, middle = self.mas_per_um / slope, _refractivity(mean_um)
        return [
            ray.moved(mas * (_refractivity(ray.wavelength_nm / 1e3) - middle), self.angle_deg) for ray in rays
        ]


def _refractivity(wavelength_um: float) -> float:
    """n − 1 of standard air, 15 °C and 1013.25 hPa (Peck & Reeder 1972, J. Opt. Soc. Am. 62, 958)."""
    wavenumber2 = wavelength_um**-2
    terms = 8060.51 + 2_480_990 / (132.274 - wavenumber2) + 17_455.7 / (39.32957 - wavenumber2)
    return 1e-8 * terms


@dataclass(frozen=True)
class PlateScale(SimulatedEffect):
    """The pixels are larger on the sky than declared, by a `fraction`."""

    name = "plate_scale"
    fraction: float = key(ge=-1.0, le=1.0)

    def pixel_scale_mas(self, assumed_mas: float) -> float:
        return assumed_mas * (1 + self.fraction)


@dataclass(frozen=True)
class Anamorphism(SimulatedEffect):
    """The image is larger along `angle_deg` than across, by a `fraction` of the mean; its area stays."""

    name = "anamorphism"
    fraction: float = key(ge=0.0, le=0.5)
    angle_deg: float = 0.0

    def stretch(self) -> np.ndarray:
        along = np.sqrt((1 + self.fraction / 2) / (1 - self.fraction / 2))
        angle = np.deg2rad(self.angle_deg)
        direction = np.array([np.cos(angle), np.sin(angle)])
        projection = np.outer(direction, direction)
        return along * projection + (np.eye(2) - projection) / along


@dataclass(frozen=True)
class Companion(SimulatedEffect):
    """Light of the star's spectrum in addition to the star's, at `sep_mas` towards `pa_deg`."""

    name = "companion"
    flux_ratio: float
    sep_mas: float
    pa_deg: float

    def rays(self, rays: list[Ray]) -> list[Ray]:
        moved = (ray.moved(self.sep_mas, self.pa_deg) for ray in rays)
        return rays + [replace(ray, weight=ray.weight * self.flux_ratio) for ray in moved]


@dataclass(frozen=True)
class Ghost(SimulatedEffect):
    """All light again, at `sep_mas` towards `pa_deg`, `defocus_nm` out of focus and blurred."""

    name = "ghost"
    flux_ratio: float
    sep_mas: float
    pa_deg: float
    defocus_nm: float = 0.0
    blur_mas: float = 0.0

    def rays(self, rays: list[Ray]) -> list[Ray]:
        return rays + [image for ray in rays for image in self._images(ray)]

    def _images(self, ray: Ray) -> list[Ray]:
        """Images of a ray, of which the ghost consists."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(GHOST_NODES if self.blur_mas else 1)
        shares = weights / weights.sum()
        middle = replace(ray.moved(self.sep_mas, self.pa_deg), defocus_nm=ray.defocus_nm + self.defocus_nm)
        return [
            replace(
                middle.moved(self.blur_mas * float(x), 0.0).moved(self.blur_mas * float(y), 90.0),
                weight=ray.weight * self.flux_ratio * float(along_x * along_y),
            )
            for x, along_x in zip(nodes, shares, strict=True)
            for y, along_y in zip(nodes, shares, strict=True)
        ]
