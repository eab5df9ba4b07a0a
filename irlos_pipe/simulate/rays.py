"""The light of a scene: at which wavelengths, from which sources, arriving where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.simulate.checks import SceneError
from irlos_pipe.simulate.scene import Scene


@dataclass(frozen=True)
class Ray:
    """Light of one wavelength from one source.

    Attributes
    ----------
    wavelength_nm, weight : float
        Weight: photons in parts of the star's.
    offset_mas : (float, float)
        Where its image lies, (x, y) from the optical axis.
    """

    wavelength_nm: float
    weight: float
    offset_mas: tuple[float, float] = (0.0, 0.0)

    def moved(self, distance_mas: float, angle_deg: float) -> Ray:
        """Displaced in a direction counted from +x towards +y."""
        angle = np.deg2rad(angle_deg)
        steps_mas = (distance_mas * float(np.cos(angle)), distance_mas * float(np.sin(angle)))
        x_mas, y_mas = (start + step for start, step in zip(self.offset_mas, steps_mas, strict=True))
        return replace(self, offset_mas=(x_mas, y_mas))


def rays_of(scene: Scene) -> list[Ray]:
    """Light of a scene, with the effects `spectrum`, `atmospheric_dispersion` and `companion`."""
    wavelengths_nm, weights = _spectrum(scene)
    star = [Ray(*point) for point in zip(wavelengths_nm.tolist(), weights.tolist(), strict=True)]
    dispersed = _dispersed(star, scene.effects.get("atmospheric_dispersion", {}))
    return dispersed + _companion(dispersed, scene.effects.get("companion", {}))


def true_pixel_scale_mas(scene: Scene) -> float:
    """Pixel scale with the effect `plate_scale`: larger by its `fraction`."""
    return scene.pixel_scale_mas * (1 + scene.effects.get("plate_scale", {}).get("fraction", 0.0))


def _spectrum(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths [nm] and weights, with the effect `spectrum`; the sum of the photons stays.

    `wavelength_nm` shifts all bands, `weights` multiply the photons of each, and `slope` is the
    relative change of the photons per µm about the mean wavelength.
    """
    wavelengths_nm, weights = np.array(scene.spectrum(), float).T
    effect = scene.effects.get("spectrum", {})
    changed = weights * _band_factors(effect.get("weights"), len(scene.bands), len(weights))
    mean_nm = np.average(wavelengths_nm, weights=changed)
    changed *= np.maximum(1 + effect.get("slope", 0.0) * (wavelengths_nm - mean_nm) / 1000, 0.0)
    return wavelengths_nm + effect.get("wavelength_nm", 0.0), changed * weights.sum() / changed.sum()


def _band_factors(factors: Sequence[float] | None, bands: int, points: int) -> np.ndarray:
    given = np.ones(bands) if factors is None else np.asarray(factors, float)
    if given.shape != (bands,):
        raise SceneError(f"effects.spectrum.weights: the scene has {bands} bands; give as many factors")
    return np.repeat(given, points // bands)


def _dispersed(rays: list[Ray], effect: Mapping[str, float]) -> list[Ray]:
    """Effect `atmospheric_dispersion`: images move by `mas_per_um` about the mean wavelength."""
    if not effect:
        return rays
    mean_nm = np.average([ray.wavelength_nm for ray in rays], weights=[ray.weight for ray in rays])
    per_nm, angle_deg = effect["mas_per_um"] / 1000, effect.get("angle_deg", 0.0)
    return [ray.moved(per_nm * (ray.wavelength_nm - mean_nm), angle_deg) for ray in rays]


def _companion(rays: list[Ray], effect: Mapping[str, float]) -> list[Ray]:
    """Light of the effect `companion`, in addition to the star's."""
    if not effect:
        return []
    moved = (ray.moved(effect["sep_mas"], effect["pa_deg"]) for ray in rays)
    return [replace(ray, weight=ray.weight * effect["flux_ratio"]) for ray in moved]
