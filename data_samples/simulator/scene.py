"""What is recorded: star, spectrum, aberrations, sky and detector of one recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulator.detector import Detector, Pixel

PHOTONS_PER_S_AT_M15 = 150_000.0
SIDE_CAR_POINTS = 3


@dataclass(frozen=True)
class Band:
    """Flat pass-band; share is its part of the photons."""

    centre_nm: float
    half_width_nm: float
    share: float = 1.0

    def points(self, count: int) -> list[tuple[float, float]]:
        """Return (wavelength [nm], weight) of the Gauss-Legendre rule with count points."""
        nodes, weights = np.polynomial.legendre.leggauss(count)
        wavelengths_nm = self.centre_nm + self.half_width_nm * nodes
        return [(float(nm), float(w)) for nm, w in zip(wavelengths_nm, weights / 2 * self.share, strict=True)]


@dataclass(frozen=True)
class Cosmic:
    """Charge left by a cosmic ray in one recorded frame: ((row, column), e-) per pixel."""

    frame: int
    charge_e: tuple[tuple[Pixel, float], ...]


@dataclass(frozen=True)
class Scene:
    """One recording.

    Attributes
    ----------
    seed : tuple of int
        Seed of everything random in this recording.
    frames : int
        Frames that reach the file.
    lost_frame : int or None
        Index, in the exposed sequence, of a frame that the recorder lost.
    subexposures : int
        Instantaneous images per frame.
    points_per_band : int
        Wavelengths simulated per band; the side-car lists SIDE_CAR_POINTS.
    flux_fraction : float
        Part of the photons of PHOTONS_PER_S_AT_M15 that the bands transmit.
    ncpa_nm, diversity_nm : dict of int to float
        Static aberrations and introduced diversity, Noll: nm RMS.
    start_s, first_counter : int
        Unix time [s] and frame counter of the first exposed frame.
    """

    name: str
    role: str
    target: str
    seed: tuple[int, ...]
    mag_j: float
    seeing_arcsec: float
    jitter_mas: float
    exposure_s: float
    frames: int
    subexposures: int
    bands: tuple[Band, ...]
    points_per_band: int
    flux_fraction: float
    ncpa_nm: dict[int, float]
    diversity_nm: dict[int, float]
    detector: Detector
    introduced_defocus_nm: float = 0.0
    window_px: int = 64
    pixel_scale_mas: float = 9.7
    lost_frame: int | None = None
    cosmic: Cosmic | None = None
    start_s: int = 1_707_618_000
    first_counter: int = 1000
    loop_hz: int = 200

    @property
    def photons(self) -> float:
        """Photons per frame through the whole aperture."""
        return PHOTONS_PER_S_AT_M15 * 10 ** (0.4 * (15 - self.mag_j)) * self.exposure_s * self.flux_fraction

    @property
    def exposed(self) -> np.ndarray:
        """Indices, in the exposed sequence, of the recorded frames."""
        total = self.frames + (self.lost_frame is not None)
        return np.array([index for index in range(total) if index != self.lost_frame])

    def spectrum(self, points_per_band: int) -> list[tuple[float, float]]:
        """Return (wavelength [nm], photon weight) with the given number of points in each band."""
        return [point for band in self.bands for point in band.points(points_per_band)]


def draw_ncpa_nm(rng: np.random.Generator, total_nm: float = 142.0, modes: int = 50) -> dict[int, float]:
    """Return random NCPAs from Noll 2 on: std 70 exp(-0.2 i) + 10 nm, i = 0 for Noll 2, scaled to total_nm.

    Tip and tilt share the deviation of Noll 2.
    """
    order = np.arange(modes)
    order[1] = 0
    drawn_nm = (70 * np.exp(-0.2 * order) + 10) * rng.standard_normal(modes)
    scaled_nm = drawn_nm * total_nm / np.linalg.norm(drawn_nm)
    return {noll: round(float(value), 6) for noll, value in enumerate(scaled_nm, start=2)}
