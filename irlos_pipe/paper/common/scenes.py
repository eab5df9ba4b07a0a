"""What the experiments simulate: calibration cubes in narrow H, stars in J and H, corrected stars."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from irlos_pipe.conventions import bands
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.simulate.atmosphere import Shape, Sky
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.scene import LENSLET_WINDOW, Sampling, Scene, draw_ncpa_nm

NARROW_H = (Band(bands.NARROW_H.centre_nm, bands.NARROW_H.half_width_nm),)
J_AND_H = tuple(Band(band.centre_nm, band.half_width_nm, 0.5) for band in (bands.J, bands.H))
NARROW_THROUGHPUT = 0.14  # width of the narrow band over that of J+H, for which the zero point holds
DIVERSITY_NM = {6: -170.0}  # astigmatism of the lens
MIRROR_DIVERSITY_NM = {6: 170.0}  # astigmatism by the deformable mirror, where the lens cannot be inserted
BY_MIRROR: dict[str, Any] = {"diversity_nm": MIRROR_DIVERSITY_NM, "diversity_source": "mirror"}
NCPA_NM, NCPA_SCATTER_NM = 142.0, 30.0
BRIGHT_MAG_J = 7.0  # star of a calibration cube, where its magnitude is not a setting
JITTER_MAS = 7.0  # RMS residual motion
LENSLET_SCALE_MAS = 78.0  # pixel scale of the 2x2 mode, the smaller of its two
LOW_GAIN = DetectorModel(e_per_adu=3.0)  # a star of m_J 7 must not saturate the converter in 0.1 s
# A second is the sum of short exposures, added where numbers do not end at 16 bits.
COADDED = DetectorModel(e_per_adu=2.5)
# Twenty moments per second. The AO residual renews itself every 10 ms, so that what a frame averages over is
# five times less than in reality, and its own defocus 4.5 nm RMS in place of 3.0 nm (seeing 0.5"): the
# errors reported on bright stars are upper limits.
COARSE = Sampling(points_per_band=2, step_s=0.05)
# Fifty moments per second, for the ramps and the cubes that they are calibrated with.
FINE = Sampling(points_per_band=3, step_s=0.02)
SEED_OF_STAR = 1  # child of a cube's seed: AO residuals differ from those of the cube that was calibrated


def cube_scene(
    name: str,
    seed: tuple[int, ...],
    facility: Facility,
    seeing_arcsec: float,
    frames: int,
    mag_j: float,
    shape: Shape = "power_law",
) -> Scene:
    """Return a calibration cube: narrow H band, 0.1 s at 10 Hz, NCPAs of 142 ± 30 nm RMS over 50 modes.

    The `seed` is that of NCPAs, AO residual and noise, the seeing on SPARTA's scale, and `shape` that of the
    AO residual's power spectrum, see `Sky`.
    """
    rng = np.random.default_rng(seed)
    total_nm = max(rng.normal(NCPA_NM, NCPA_SCATTER_NM), NCPA_SCATTER_NM)
    return Scene(
        name, facility, NARROW_H, seed, frames, 0.1,
        mag_j=mag_j, throughput=NARROW_THROUGHPUT,
        ncpa_nm=draw_ncpa_nm(rng, facility.ncpa_law, total_nm), diversity_nm=DIVERSITY_NM,
        sky=Sky(seeing_arcsec=seeing_arcsec, shape=shape), motion=Motion(rms_mas=JITTER_MAS),
        detector=LOW_GAIN, sampling=Sampling(points_per_band=3),
    )  # fmt: skip


def star_scene(
    name: str,
    facility: Facility,
    seed: tuple[int, ...],
    frames: int,
    mag_j: float,
    ncpa_nm: Mapping[int, float],
    introduced_nm: float | tuple[float, ...] = 0.0,
    *,
    seeing_arcsec: float,
) -> Scene:
    """Return frames of one second in J and H, one after the other, with the astigmatic lens; see `Scene`."""
    return Scene(
        name, facility, J_AND_H, seed, frames, 1.0,
        role="defocus_ramp", mag_j=mag_j, frame_rate_hz=1.0,
        ncpa_nm=ncpa_nm, diversity_nm=DIVERSITY_NM, introduced_nm=introduced_nm,
        sky=Sky(seeing_arcsec), motion=Motion(JITTER_MAS), detector=COADDED, sampling=COARSE,
    )  # fmt: skip


def in_four_images(star: Scene) -> Scene:
    """Return the same frames of a `star` in the 2x2 mode, which has no lens for the diversity."""
    return replace(
        star, window=LENSLET_WINDOW, pixel_scale_mas=LENSLET_SCALE_MAS, lenslets=2, diversity_nm={}
    )


def star_image(cube: Scene, frames: int, ncpa_nm: Mapping[int, float]) -> tuple[np.ndarray, float]:
    """Return the averaged image of the star of a `cube` without diversity, and its Strehl ratio.

    The star has the aberrations `ncpa_nm` in place of those of the cube, and a mirror keeps its offsets. The
    image, (rows, columns), is the part of the photons per pixel; the ratio is that of its peak to that of a
    star without any aberration.
    """
    seed = (*cube.seed, SEED_OF_STAR)
    star = replace(cube, ncpa_nm=dict(ncpa_nm), diversity_nm={}, frames=frames, seed=seed)
    image = expose(star).mean_e.mean(axis=0, dtype=float) / star.photons
    still = replace(star, ncpa_nm={}, mirror=None, sky=None, motion=None, frames=1)
    perfect = expose(still).mean_e[0] / star.photons
    return image, float(image.max() / perfect.max())
