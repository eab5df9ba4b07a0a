"""The star of a focus measurement: J and H together, frames of a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from irlos_pipe.conventions import bands
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.paper.common.cube import DIVERSITY_NM, JITTER_MAS
from irlos_pipe.paper.common.observation import settings_of
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.scene import LENSLET_WINDOW, Sampling, Scene

J_AND_H = tuple(Band(band.centre_nm, band.half_width_nm, 0.5) for band in (bands.J, bands.H))
# A second is the sum of short exposures, added where numbers do not end at 16 bits.
COADDED = DetectorModel(e_per_adu=2.5)
# Twenty moments per second. The AO residual renews itself every 10 ms, so that what a frame averages over is
# five times less than in reality, and its own defocus 4.5 nm RMS in place of 3.0 nm (seeing 0.5"): the
# errors reported on bright stars are upper limits.
COARSE = Sampling(points_per_band=2, step_s=0.05)
# Fifty moments per second, for the ramps and the cubes that they are calibrated with.
FINE = Sampling(points_per_band=3, step_s=0.02)

FRAME_MARGIN_MAS = 100.0  # field beyond the window, enough for single frames
LENSLET_SCALE_MAS = 78.0  # the small one of the 2x2 mode


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
    """Return frames of one second, one after the other, with the astigmatic lens.

    Parameters
    ----------
    name, facility, seed, frames, mag_j, ncpa_nm, introduced_nm
        See `Scene`.
    seeing_arcsec : float
        On SPARTA's scale.
    """
    return Scene(
        name,
        facility,
        J_AND_H,
        seed,
        frames,
        exposure_s=1.0,
        role="defocus_ramp",
        mag_j=mag_j,
        frame_rate_hz=1.0,
        ncpa_nm=ncpa_nm,
        diversity_nm=DIVERSITY_NM,
        introduced_nm=introduced_nm,
        sky=Sky(seeing_arcsec),
        motion=Motion(JITTER_MAS),
        detector=COADDED,
        sampling=COARSE,
    )


def in_four_images(star: Scene) -> Scene:
    """Return the same frames of a `star` in the 2x2 mode, which has no lens for the diversity."""
    return replace(
        star, window=LENSLET_WINDOW, pixel_scale_mas=LENSLET_SCALE_MAS, lenslets=2, diversity_nm={}
    )


def frame_settings(scene: Scene, ncpa_nm: Mapping[int, float]) -> PsfSettings:
    """Return settings for single frames of `scene` with known `ncpa_nm`.

    The centre of each band stands for it: two or three wavelengths per band change the defocus of a
    frame by less than 0.1 nm and take two or three times as long.
    """
    settings = settings_of(scene, ncpa_nm)
    return replace(settings, spectrum=tuple(scene.spectrum(1)), margin_mas=FRAME_MARGIN_MAS)
