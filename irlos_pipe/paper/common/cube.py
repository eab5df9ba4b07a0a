"""Calibration cubes as in the paper's simulations, and how far an estimate is from their truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions import bands
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import REPORTED_NOLLS
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.wavefront import modes_at, opd_maps_nm
from irlos_pipe.paper.common.observation import frames_of, model_effects_of, settings_of
from irlos_pipe.paper.common.variants import Variant
from irlos_pipe.simulate.atmosphere import Shape, Sky
from irlos_pipe.simulate.detector import DetectorModel
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Sampling, Scene

NARROW_H = (Band(bands.NARROW_H.centre_nm, bands.NARROW_H.half_width_nm),)
NARROW_THROUGHPUT = 0.14  # width of the narrow band over that of J+H, for which the zero point holds
DIVERSITY_NM = {6: -170.0}  # of the astigmatic lens
MIRROR_DIVERSITY_NM = {6: 170.0}  # of the deformable mirror, where the lens cannot be inserted
NCPA_NM, NCPA_SCATTER_NM = 142.0, 30.0
BRIGHT_MAG_J = 7.0  # of the star of a calibration cube, where it is not a setting
JITTER_MAS = 7.0  # RMS residual motion
LOW_GAIN = DetectorModel(e_per_adu=3.0)  # a star of m_J 7 must not saturate the converter in 0.1 s


@dataclass(frozen=True)
class CubeSample:
    """One calibration cube with NCPAs of its own.

    Attributes
    ----------
    seed : tuple of int
        Of the NCPAs, the AO residual and the noise.
    seeing_arcsec : float
        On SPARTA's scale.
    shape : Shape
        Of the AO residual's power spectrum, see `Sky`.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    seeing_arcsec: float
    frames: int
    mag_j: float
    shape: Shape = "power_law"

    def scene(self) -> Scene:
        """Return the recording: narrow H band, 0.1 s at 10 Hz, NCPAs of 142 ± 30 nm RMS over 50 modes."""
        rng = np.random.default_rng(self.seed)
        total_nm = max(rng.normal(NCPA_NM, NCPA_SCATTER_NM), NCPA_SCATTER_NM)
        return Scene(
            self.name,
            self.facility,
            NARROW_H,
            self.seed,
            self.frames,
            0.1,
            mag_j=self.mag_j,
            throughput=NARROW_THROUGHPUT,
            ncpa_nm=draw_ncpa_nm(rng, self.facility.ncpa_law, total_nm),
            diversity_nm=DIVERSITY_NM,
            sky=Sky(seeing_arcsec=self.seeing_arcsec, shape=self.shape),
            motion=Motion(rms_mas=JITTER_MAS),
            detector=LOW_GAIN,
            sampling=Sampling(points_per_band=3),
        )


@dataclass(frozen=True)
class ObservedCube:
    """A simulated cube: what an observer has of it, and its truth.

    Attributes
    ----------
    scene : Scene
    exposed : Exposed
        Noise-free images and wavefronts of all frames of the scene.
    frames : Frames
        The noisy frames in use, the first ones of the scene.
    """

    scene: Scene
    exposed: Exposed
    frames: Frames

    @classmethod
    def of(cls, scene: Scene) -> ObservedCube:
        """Expose a scene and add the noise."""
        exposed = expose(scene)
        return cls(scene, exposed, frames_of(scene, exposed))

    @property
    def settings(self) -> PsfSettings:
        """Return the settings of the PSF model that an observer knows."""
        return settings_of(self.scene)

    @property
    def effects(self) -> list[Effect]:
        """Return AO residual and jitter, to be estimated."""
        return model_effects_of(self.scene)

    def first(self, count: int) -> ObservedCube:
        """Return the same cube with its first `count` frames only."""
        return replace(self, frames=replace(self.frames, images_e=self.frames.images_e[:count]))

    def dimmed(self, mag_j: float) -> ObservedCube:
        """Return the same sky with a star of magnitude `mag_j` and noise of its own."""
        scene = replace(self.scene, mag_j=mag_j)
        factor = np.float32(scene.photons / self.scene.photons)
        exposed = replace(self.exposed, mean_e=self.exposed.mean_e * factor)
        return ObservedCube(scene, exposed, frames_of(scene, exposed))

    def calibrated(self, variant: Variant) -> Calibration:
        """Estimate the NCPAs by one variant of the calibration."""
        return variant.calibrate(self.frames, self.settings, self.effects, self.scene.facility.ncpa_law)

    def introduced_wfe_nm(self) -> float:
        """Return the RMS over the pupil of the time-averaged wavefront without diversity [nm]."""
        return self._rms(self.exposed.mean_opd_nm[self._lit])

    def pupil_delta_nm(self, calibration: Calibration) -> float:
        """Return Δ-WFE over the full pupil: RMS of true minus estimated wavefront, piston removed [nm].

        The truth is the time-averaged wavefront of all frames, diversity excluded.
        """
        estimated_nm = calibration.zernike_nm @ modes_at(calibration.nolls, self._lit)
        return self._rms(self.exposed.mean_opd_nm[self._lit] - estimated_nm)

    def modes_delta_nm(self, calibration: Calibration) -> float:
        """Return Δ-WFE in Noll 2–30 against the mean wavefront of the frames in use [nm RMS]."""
        used = self.exposed.zernike_nm[: len(self.frames.images_e)]
        true_nm = used.mean(axis=0)[: len(REPORTED_NOLLS)]
        given_nm = dict(zip(calibration.nolls, calibration.zernike_nm, strict=True))
        difference_nm = true_nm - np.array([given_nm.get(noll, 0.0) for noll in REPORTED_NOLLS])
        return self._rms(difference_nm @ modes_at(REPORTED_NOLLS, self._lit))

    def wavefront_nm(self, calibration: Calibration) -> np.ndarray:
        """Return the estimated wavefront on the simulator's pupil grid, (n, n); NaN outside the pupil."""
        return opd_maps_nm(calibration.nolls, calibration.zernike_nm, self._lit)

    @property
    def _lit(self) -> np.ndarray:
        return self.exposed.transmission > 0

    def _rms(self, values: np.ndarray) -> float:
        """RMS over the lit samples about their mean, weighted by the transmission."""
        weight = self.exposed.transmission[self._lit]
        mean = np.average(values, weights=weight)
        return float(np.sqrt(np.average((values - mean) ** 2, weights=weight)))
