"""What an observer makes of a simulated recording: electrons, a model of the optics, and how wrong it is.

The model is built from what a side-car would tell (three wavelengths per band, the diversity, the
seeing), never from the truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.effects import Conditions, Effect, SeeingHalo, TipTiltJitter
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.pupil import grid_centres
from irlos_pipe.optics.structure import ResidualBand
from irlos_pipe.optics.zernike import zernike_basis
from irlos_pipe.simulate.detector import electrons
from irlos_pipe.simulate.exposure import Exposed
from irlos_pipe.simulate.scene import Scene

SIDE_CAR_POINTS = 3  # wavelengths per band that a side-car lists
REPORTED = tuple(range(2, 31))  # the 29 modes
PHOTON_STREAM = 1  # child of the scene's seed that the detector noise is drawn from


def settings_of(scene: Scene, ncpa_nm: Mapping[int, float] | None = None) -> PsfSettings:
    """Settings of the PSF model for a scene, with NCPAs to hold."""
    known = KnownWavefront(scene.diversity_nm, ncpa_nm=ncpa_nm or {})
    spectrum = tuple(scene.spectrum(SIDE_CAR_POINTS))
    return PsfSettings(scene.geometry, scene.window, scene.pixel_scale_mas, spectrum, known)


def model_effects_of(scene: Scene) -> list[Effect]:
    """AO residual and jitter, starting from the seeing that a side-car tells."""
    facility = scene.facility
    conditions = Conditions(
        settings_of(scene),
        ResidualBand(1 / facility.pupil.diameter_m, facility.cutoff_per_m, facility.outer_scale_m),
        facility.residual_law,
        scene.sky.seeing_arcsec if scene.sky else facility.typical_seeing_arcsec,
        HIGHEST_REPORTED_NOLL,
    )
    return [SeeingHalo.under(conditions), TipTiltJitter.under(conditions)]


def noise_of(scene: Scene) -> NoiseModel:
    """Noise model from the detector constants."""
    return NoiseModel(scene.detector.excess_noise_factor, scene.detector.read_noise_e**2)


def images_of(scene: Scene, exposed: Exposed) -> torch.Tensor:
    """Noisy frames in electrons, (frames, rows, columns), seeded by the scene."""
    rng = np.random.default_rng([*scene.seed, PHOTON_STREAM])
    return torch.as_tensor(electrons(scene, exposed.mean_e, rng))


def frames_of(scene: Scene, exposed: Exposed) -> Frames:
    """A calibration cube with noise."""
    good = torch.ones(scene.window, dtype=torch.bool)
    return Frames(images_of(scene, exposed), good, noise_of(scene))


@dataclass(frozen=True)
class DeltaWfe:
    """Δ-WFE of an estimate: RMS over the pupil of true minus estimated wavefront [nm].

    Attributes
    ----------
    pupil_nm : float
        Over the full pupil, piston removed: of the time-averaged wavefront, all it contains.
    modes_nm : float
        Of its part in the reported modes, Noll 2–30.
    """

    pupil_nm: float
    modes_nm: float


def delta_wfe(exposed: Exposed, nolls: Sequence[int], zernike_nm: np.ndarray) -> DeltaWfe:
    """Compare an estimate with the time-averaged true wavefront, diversity excluded.

    Parameters
    ----------
    nolls, zernike_nm : (modes,)
        The estimate [nm RMS].
    """
    lit = exposed.transmission > 0
    estimated_nm = zernike_nm @ _modes_on(exposed, nolls, lit)
    rest_nm = exposed.mean_opd_nm[lit] - estimated_nm
    return DeltaWfe(_rms(rest_nm, exposed.transmission[lit]), modes_delta_nm(exposed, nolls, zernike_nm))


def introduced_wfe_nm(exposed: Exposed) -> float:
    """RMS over the pupil of the time-averaged wavefront without diversity [nm]."""
    lit = exposed.transmission > 0
    return _rms(exposed.mean_opd_nm[lit], exposed.transmission[lit])


def modes_delta_nm(
    exposed: Exposed, nolls: Sequence[int], zernike_nm: np.ndarray, first_frames: int | None = None
) -> float:
    """Δ-WFE in Noll 2–30 against the mean wavefront of all or of the first frames [nm]."""
    lit = exposed.transmission > 0
    true_nm = exposed.zernike_nm[:first_frames].mean(axis=0)[: len(REPORTED)]
    given_nm = dict(zip(nolls, zernike_nm, strict=True))
    difference_nm = true_nm - np.array([given_nm.get(noll, 0.0) for noll in REPORTED])
    return _rms(difference_nm @ _modes_on(exposed, REPORTED, lit), exposed.transmission[lit])


def wavefront_nm(exposed: Exposed, nolls: Sequence[int], zernike_nm: np.ndarray) -> np.ndarray:
    """Estimated wavefront on the simulator's pupil grid, (n, n); NaN outside the pupil."""
    lit = exposed.transmission > 0
    image = np.full(lit.shape, np.nan)
    image[lit] = zernike_nm @ _modes_on(exposed, nolls, lit)
    return image


def _modes_on(exposed: Exposed, nolls: Sequence[int], lit: np.ndarray) -> np.ndarray:
    """Zernikes at the lit samples, (modes, samples)."""
    samples = len(exposed.transmission)
    x, y = np.meshgrid(*[grid_centres(samples, 2 / samples)] * 2)
    return zernike_basis(nolls, x[lit], y[lit])


def _rms(values: np.ndarray, weight: np.ndarray) -> float:
    """Weighted RMS about the weighted mean."""
    mean = np.average(values, weights=weight)
    return float(np.sqrt(np.average((values - mean) ** 2, weights=weight)))
