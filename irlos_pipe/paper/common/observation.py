"""What an observer makes of a simulated recording: electrons, and a model of the optics.

The model is built from what a side-car states (three wavelengths per band, the diversity, the
seeing), never from the truth.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.effects import Conditions, Effect, SeeingHalo, TipTiltJitter
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import ExposureNoise, NoiseModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.simulate.exposure import Exposed
from irlos_pipe.simulate.readout import electrons
from irlos_pipe.simulate.scene import Scene

SIDE_CAR_POINTS = 3  # wavelengths per band that a side-car lists
PHOTON_STREAM = 1  # child of the scene's seed that the detector noise is drawn from


def settings_of(scene: Scene, ncpa_nm: Mapping[int, float] | None = None) -> PsfSettings:
    """Return the settings of the PSF model of a `scene` with known NCPAs `ncpa_nm` (Noll: nm RMS)."""
    known = KnownWavefront(diversity_nm=scene.diversity_nm, ncpa_nm=ncpa_nm or {})
    spectrum = tuple(scene.spectrum(SIDE_CAR_POINTS))
    return PsfSettings(
        scene.geometry, scene.window, scene.pixel_scale_mas, spectrum, known, lenslets=scene.lenslets
    )


def seeing_of(scene: Scene) -> float:
    """Return the seeing that a side-car states [arcsec]."""
    return scene.sky.seeing_arcsec if scene.sky else scene.facility.typical_seeing_arcsec


def conditions_of(scene: Scene, ncpa_wavelength_nm: float | None = None) -> Conditions:
    """Return what effects of the model of a `scene` start from: what a side-car and the profile state.

    Parameters
    ----------
    scene : Scene
    ncpa_wavelength_nm : float, optional
        At which NCPAs that differ by wavelength are stated.
    """
    facility = scene.facility
    return Conditions(
        settings_of(scene),
        ResidualBand(1 / facility.pupil.diameter_m, facility.cutoff_per_m, facility.outer_scale_m),
        facility.residual_law,
        seeing_of(scene),
        HIGHEST_REPORTED_NOLL,
        ncpa_law=facility.ncpa_law,
        elements=(scene.diversity_source,),
        ncpa_wavelength_nm=ncpa_wavelength_nm,
    )


def model_effects_of(scene: Scene) -> list[Effect]:
    """Return AO residual and jitter, starting from the seeing that a side-car states."""
    conditions = conditions_of(scene)
    return [SeeingHalo.under(conditions), TipTiltJitter.under(conditions)]


def noise_of(scene: Scene) -> NoiseModel:
    """Return the noise model of an exposure, from its reads, the light of the sky and dark current."""
    told = exposure_noise(scene)
    return NoiseModel(told.excess_noise_factor, told.floor_e2)


def exposure_noise(scene: Scene) -> ExposureNoise:
    """Return what makes the noise of an exposure of a `scene`."""
    detector, exposure_s = scene.detector, scene.exposure_s
    return ExposureNoise(
        detector.reads(exposure_s),
        detector.read_noise_e,
        detector.excess_noise_factor,
        scene.sky_e_per_s * exposure_s,
        detector.dark_e_per_s * exposure_s,
    )


def images_of(scene: Scene, exposed: Exposed) -> torch.Tensor:
    """Return the frames of `scene`, `exposed` without noise, as the detector gives them.

    Returns
    -------
    Tensor, (frames, rows, columns)
        Electrons; the noise is drawn with the scene's seed.
    """
    rng = np.random.default_rng([*scene.seed, PHOTON_STREAM])
    return torch.as_tensor(recorded_e(scene, exposed.mean_e, rng))


def recorded_e(scene: Scene, mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return noisy frames of the mean light `mean_e` as ingest leaves them: without the sky's mean light.

    Parameters
    ----------
    scene : Scene
    mean_e : ndarray, (frames, rows, columns)
        Of the star [e-].
    rng : Generator

    Returns
    -------
    ndarray, (frames, rows, columns), float32
        Electrons.
    """
    return electrons(scene, mean_e, rng) - np.float32(scene.sky_e_per_s * scene.exposure_s)


def frames_of(scene: Scene, exposed: Exposed) -> Frames:
    """Return the noisy frames of `scene`, `exposed` without noise; every pixel is good."""
    good = torch.ones(scene.window, dtype=torch.bool)
    return Frames(images_of(scene, exposed), good, noise_of(scene))
