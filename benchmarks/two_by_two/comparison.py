"""Defocus from the same photons, reads and sky: full-pupil LIFT, LIFT on four images, and their centroids.

Images are those of the simulator, which shares no optics with the model; wavefront and noise are what the
estimators believe. Without AO residual, image motion and errors of the NCPAs, in all three alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.bands import H, J
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lenslets import modes_of_centroids_nm
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.sensitivity import cramer_rao_nm
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.paper.common.scenes import in_four_images
from irlos_pipe.simulate.detector import multiplied
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.scene import Scene

TTF = (2, 3, 4)
BANDS = (Band.of(J, 0.5), Band.of(H, 0.5))
EXCESS, READ_NOISE_E, READ_S = 1.25, 1.0, 0.005
TRUE_NM, DIVERSITY_NM = 60.0, {6: -170.0}
RANGE_NM = 900.0  # of defocus, beyond which a frame is lost, as for the loop
BELIEVED_POINTS = 3  # per band; the simulator has more


@dataclass(frozen=True)
class Point:
    """One magnitude: RMS error of defocus and its bound, by estimator [nm]; part of the frames lost."""

    mag_j: float
    photons: float
    full_nm: float
    full_bound_nm: float
    full_lost: float
    four_nm: float
    four_bound_nm: float
    centroids_nm: float
    centroids_bias_nm: float


def compared(mags: list[float], realisations: int, exposure_s: float, seed: int) -> list[Point]:
    """Return the errors over `realisations` of the noise of exposures of `exposure_s`, by magnitude."""
    irlos = load_instrument("irlos")
    rng = np.random.default_rng(seed)
    full = Scene(
        "full", irlos.facility, BANDS, (seed,), 1, exposure_s, ncpa_nm={4: TRUE_NM}, diversity_nm=DIVERSITY_NM
    )
    four = replace(in_four_images(full), name="four")
    sides = [_Side(scene, realisations, rng) for scene in (full, four)]
    return [_point(mag_j, *sides) for mag_j in mags]


class _Side:
    """One mode of the sensor: its light, its noise, its model."""

    def __init__(self, scene: Scene, realisations: int, rng: np.random.Generator):
        self.scene, self.realisations, self.rng = scene, realisations, rng
        self.unit = expose(scene).mean_e[0].astype(float) / scene.photons
        believed = tuple(scene.spectrum(BELIEVED_POINTS))
        known = KnownWavefront(scene.diversity_nm)
        settings = PsfSettings(
            scene.geometry, scene.window, scene.pixel_scale_mas, believed, known, lenslets=scene.lenslets
        ).for_broad_images()
        self.settings = settings.for_single_frames()
        self.model = ImageModel(light_path(self.settings, TTF))
        facility = scene.facility
        photons_per_s_m0 = facility.photons_per_s_m15 * 10 ** (0.4 * 15)
        lit = [(band.centre_nm, band.share) for band in scene.bands]
        sky_per_s = facility.sky_photons_per_s(lit, photons_per_s_m0, scene.pixel_scale_mas)
        self.sky_e = sky_per_s * scene.exposure_s / scene.lenslets**2
        reads = scene.exposure_s / READ_S
        self.noise = NoiseModel(EXCESS, reads * READ_NOISE_E**2 + EXCESS * self.sky_e)

    def photons(self, mag_j: float) -> float:
        """Photons of an exposure through the whole pupil."""
        return replace(self.scene, mag_j=mag_j).photons

    def images_e(self, mag_j: float) -> np.ndarray:
        """Frames of a star, the mean sky taken off."""
        mean = np.broadcast_to(
            self.photons(mag_j) * self.unit + self.sky_e, (self.realisations, *self.unit.shape)
        )
        signal = multiplied(self.rng.poisson(mean), EXCESS, self.rng)
        reads = self.scene.exposure_s / READ_S
        return signal - self.sky_e + np.sqrt(reads) * READ_NOISE_E * self.rng.standard_normal(mean.shape)

    def by_lift(self, images_e: np.ndarray) -> np.ndarray:
        """Defocus of every frame [nm], NaN where it is lost."""
        images = torch.as_tensor(images_e)
        good = torch.ones(images.shape[1:], dtype=torch.bool)
        if self.scene.lenslets > 1:  # four images show the sign of defocus, and any start does
            start = torch.zeros(len(images), len(TTF), dtype=torch.float64)
        else:
            start = scan_start_nm(self.model.psf, images, good)
        found = lift(self.model, images, good, self.noise, start).mode(4)[0].numpy()
        return np.where(np.abs(found) < RANGE_NM, found, np.nan)

    def bound_nm(self, mag_j: float) -> float:
        """Cramér–Rao bound of defocus."""
        wavefront = torch.tensor([[0.0, 0.0, TRUE_NM]], dtype=torch.float64)
        flux = torch.tensor([self.photons(mag_j)], dtype=torch.float64)
        return float(cramer_rao_nm(self.model, wavefront, flux, self.noise)[0, 2])


def _point(mag_j: float, full: _Side, four: _Side) -> Point:
    images_e = four.images_e(mag_j)
    floor_e = float(np.sqrt(four.noise.floor_e2))
    scale, geometry = four.scene.pixel_scale_mas, four.scene.geometry
    by_full = full.by_lift(full.images_e(mag_j))
    centroids = modes_of_centroids_nm(images_e, geometry, scale, floor_e, TTF)[:, 2]
    return Point(
        mag_j,
        full.photons(mag_j),
        _rms(by_full - TRUE_NM),
        full.bound_nm(mag_j),
        float(np.isnan(by_full).mean()),
        _rms(four.by_lift(images_e) - TRUE_NM),
        four.bound_nm(mag_j),
        _rms(centroids - TRUE_NM),
        float(np.mean(centroids) - TRUE_NM),
    )


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))


def rows(points: list[Point]) -> Iterator[str]:
    """Yield the lines of a Markdown table."""
    yield (
        "| J | photons | full pupil, LIFT | bound | lost "
        "| four images, LIFT | bound | centroids | their bias |"
    )
    yield "|---|---|---|---|---|---|---|---|---|"
    for one in points:
        yield (
            f"| {one.mag_j:.0f} | {one.photons:.2g} | {one.full_nm:.1f} | {one.full_bound_nm:.1f} | "
            f"{one.full_lost:.0%} | {one.four_nm:.1f} | {one.four_bound_nm:.1f} | {one.centroids_nm:.1f} | "
            f"{one.centroids_bias_nm:+.1f} |"
        )


def as_json(points: list[Point]) -> list[dict]:
    """Return all numbers in JSON types."""
    return [asdict(one) for one in points]
