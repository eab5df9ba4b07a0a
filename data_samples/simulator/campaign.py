"""What is recorded: star, spectrum, aberrations, sky and detector of every recording.

The data samples are one calibration cube, one defocus ramp and one MUSE raw file; behind an adaptive optics
that is simulated end to end there are a cube and a ramp per seeing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from simulator.detector import Detector, Pixel

PHOTONS_PER_S_AT_M15 = 150_000.0
SIDE_CAR_POINTS = 3
SEED = 20240211
NCPA_SEED = (SEED, 5)  # the first draw in which tip and tilt hold no more than their expected share
# Width of the narrow band over that of J+H: the photometric zero point holds for J+H.
NARROW_FLUX_FRACTION = 0.14
RAMP_OFFSETS_NM = (-300.0, -200.0, -100.0, 0.0, 100.0, 200.0, 300.0)
# The stage changes its direction of travel before every offset, from the outside inwards.
RAMP_ORDER = (0, 6, 1, 5, 2, 4, 3)
RAMP_MOVE_S = 24
END_TO_END_SEED = 20261123
SEEINGS_ARCSEC = (0.5, 1.0)
END_TO_END_OFFSETS_NM = (-300.0, -150.0, 0.0, 150.0, 300.0)


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
    """One recording; aberrations are Noll: nm RMS."""

    name: str
    role: str
    target: str
    seed: tuple[int, ...]  # of everything random in this recording
    mag_j: float
    seeing_arcsec: float
    jitter_mas: float
    exposure_s: float
    frames: int  # that reach the file
    subexposures: int  # instantaneous images per frame
    bands: tuple[Band, ...]
    points_per_band: int  # that are simulated; the side-car lists SIDE_CAR_POINTS
    flux_fraction: float  # part of the photons of PHOTONS_PER_S_AT_M15 that the bands transmit
    ncpa_nm: dict[int, float]
    diversity_nm: dict[int, float]
    detector: Detector
    introduced_defocus_nm: float = 0.0
    window_px: int = 64
    pixel_scale_mas: float = 9.7
    lost_frame: int | None = None  # index, in the exposed sequence, of a frame that the recorder lost
    cosmic: Cosmic | None = None
    start_s: int = 1_707_618_000  # of the first exposed frame, as its counter
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


# Three-point Gauss-Legendre nodes of these bands lie at 1170, 1215, 1260 and 1560, 1625, 1690 nm.
BROAD_J_H = (Band(1215.0, 45 / np.sqrt(0.6), 0.5), Band(1625.0, 65 / np.sqrt(0.6), 0.5))
CLEAN_DETECTOR = Detector(e_per_adu=2.0, pedestal_adu=200.0)
CALIBRATION = Scene(
    name="calibration-sky",
    role="ncpa_calibration",
    target="SIM-CAL",
    seed=(SEED, 1),
    mag_j=7.0,
    seeing_arcsec=0.5,
    jitter_mas=7.0,
    exposure_s=0.1,
    frames=200,
    subexposures=25,
    bands=(Band(1600.0, 20.0),),
    points_per_band=5,
    flux_fraction=NARROW_FLUX_FRACTION,
    ncpa_nm=draw_ncpa_nm(np.random.default_rng(NCPA_SEED)),
    diversity_nm={6: -170.0},
    detector=Detector(
        e_per_adu=2.0,
        dead=((26, 37),),
        hot_e_per_s=(((12, 50), 20_000.0),),
        hot_after_dark_e_per_s=(((47, 15), 8_000.0),),
    ),
    lost_frame=120,
    cosmic=Cosmic(77, (((18, 45), 30_000.0), ((18, 46), 12_000.0), ((19, 47), 5_000.0))),
)
MUSE = replace(
    CALIBRATION,
    name="MUSE.2024-02-11T03:05:20.000",
    target="SIM-MUSE",
    seed=(SEED, 2),
    mag_j=9.0,
    frames=40,
    detector=CLEAN_DETECTOR,
    lost_frame=None,
    cosmic=None,
    start_s=1_707_620_720,
)


def sample_scenes() -> list[Scene]:
    """Return the scenes of the data samples, the longest first; times give the order of the ramp."""
    ramp = [
        _ramp_step(
            CALIBRATION,
            600 + RAMP_ORDER.index(index) * RAMP_MOVE_S,
            name=f"ramp/offset_{index:02d}",
            seed=(SEED, 3, index),
            frames=6,
            points_per_band=11,
            introduced_defocus_nm=offset_nm,
        )
        for index, offset_nm in enumerate(RAMP_OFFSETS_NM)
    ]
    return [CALIBRATION, *ramp, MUSE]


def end_to_end_scenes(seed: int = END_TO_END_SEED) -> list[Scene]:
    """Return the scenes behind the end-to-end loop; each seeing has NCPAs of its own, drawn from `seed`."""
    cubes = [
        replace(
            CALIBRATION,
            name=f"seeing_{seeing:.2f}/calibration",
            seed=(seed, index, 0),
            seeing_arcsec=seeing,
            ncpa_nm=draw_ncpa_nm(np.random.default_rng((seed, index))),
            detector=CLEAN_DETECTOR,
            lost_frame=None,
            cosmic=None,
        )
        for index, seeing in enumerate(SEEINGS_ARCSEC)
    ]
    ramps = [
        _ramp_step(
            cube,
            600 + RAMP_MOVE_S * index,
            name=f"{cube.name.partition('/')[0]}/ramp/offset_{index:02d}",
            seed=(*cube.seed, 1, index),
            frames=3,
            points_per_band=7,
            introduced_defocus_nm=offset_nm,
        )
        for cube in cubes
        for index, offset_nm in enumerate(END_TO_END_OFFSETS_NM)
    ]
    return [*cubes, *ramps]


def _ramp_step(cube: Scene, delay_s: int, **its: Any) -> Scene:
    """A step of a ramp behind the optics of a `cube`, `delay_s` after it, with fields of `its` own."""
    return replace(
        cube,
        role="defocus_ramp",
        target="SIM-RAMP",
        mag_j=12.0,
        exposure_s=1.0,
        subexposures=100,
        bands=BROAD_J_H,
        flux_fraction=1.0,
        lost_frame=None,
        cosmic=None,
        start_s=cube.start_s + delay_s,
        first_counter=cube.first_counter + delay_s * cube.loop_hz,
        **its,
    )
