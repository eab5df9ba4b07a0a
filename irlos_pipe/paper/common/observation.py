"""What an observer makes of a simulated recording: electrons, and a model of the optics.

The model is built from what a side-car states (three wavelengths per band, the diversity, the seeing), never
from the truth. Exposures can have the noise of many reads, with dark current and sky, as the profile says;
the published experiments idealise: one read per exposure, and no sky.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.effects import Conditions, Effect, SeeingHalo, TipTiltJitter
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import ExposureNoise, NoiseModel
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.optics.psf_settings import FRAME_MARGIN_MAS, KnownWavefront, PsfSettings
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.simulate.exposure import Exposed
from irlos_pipe.simulate.readout import electrons
from irlos_pipe.simulate.scene import Scene

SIDE_CAR_POINTS = 3  # wavelengths per band that a side-car lists
PHOTON_STREAM = 1  # child of the scene's seed that the detector noise is drawn from
MONITOR = "mass_dimm"  # seeing monitor by which the paper states the seeing on sky
NoiseOf = Annotated[
    Literal["reads", "one_read"],
    Field(description="of exposures: all their reads with sky and dark, or one read without"),
]


# -- the optics --------------------------------------------------------------------------------------


def settings_of(scene: Scene, ncpa_nm: Mapping[int, float] | None = None) -> PsfSettings:
    """Return the settings of the PSF model of a `scene` with known NCPAs `ncpa_nm` (Noll: nm RMS)."""
    known = KnownWavefront(diversity_nm=scene.diversity_nm, ncpa_nm=ncpa_nm or {})
    spectrum = tuple(scene.spectrum(SIDE_CAR_POINTS))
    return PsfSettings(
        scene.geometry, scene.window, scene.pixel_scale_mas, spectrum, known, lenslets=scene.lenslets
    )


def frame_settings(scene: Scene, ncpa_nm: Mapping[int, float]) -> PsfSettings:
    """Return settings for single frames of `scene` with known `ncpa_nm`.

    The centre of each band stands for it: two or three wavelengths per band change the defocus of a
    frame by less than 0.1 nm and take two or three times as long.
    """
    settings = settings_of(scene, ncpa_nm)
    return replace(settings, spectrum=tuple(scene.spectrum(1)), margin_mas=FRAME_MARGIN_MAS)


def seeing_of(scene: Scene) -> float:
    """Return the seeing that a side-car states [arcsec]."""
    return scene.sky.seeing_arcsec if scene.sky else scene.facility.typical_seeing_arcsec


def on_spartas_scale(instrument: Instrument, seeing_arcsec: float) -> float:
    """Return a seeing by MASS-DIMM on SPARTA's scale, which the AO residual follows [arcsec]."""
    return float(instrument.seeing_scales[MONITOR].to_sparta(seeing_arcsec))


def conditions_of(scene: Scene, ncpa_wavelength_nm: float | None = None) -> Conditions:
    """Return what effects of the model of a `scene` start from: what a side-car and the profile state.

    NCPAs that differ by wavelength are stated at `ncpa_wavelength_nm`.
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


# -- the frames --------------------------------------------------------------------------------------


def noise_of(scene: Scene) -> NoiseModel:
    """Return the noise model of an exposure, from its reads, the light of the sky and dark current."""
    of_exposure = exposure_noise(scene)
    return NoiseModel(of_exposure.excess_noise_factor, of_exposure.floor_e2)


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


def recorded_e(scene: Scene, mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return noisy frames [e-] of the mean light of the star `mean_e`, (frames, rows, columns) [e-].

    As ingest leaves them: without the sky's mean light.
    """
    return electrons(scene, mean_e, rng) - np.float32(scene.sky_e_per_s * scene.exposure_s)


def images_of(scene: Scene, exposed: Exposed) -> torch.Tensor:
    """Return `recorded_e` of a `scene`, `exposed` without noise; the noise is drawn with its seed."""
    rng = np.random.default_rng([*scene.seed, PHOTON_STREAM])
    return torch.as_tensor(recorded_e(scene, exposed.mean_e, rng))


def frames_of(scene: Scene, exposed: Exposed) -> Frames:
    """Return the noisy frames of `scene`, `exposed` without noise; every pixel is good."""
    good = torch.ones(scene.window, dtype=torch.bool)
    return Frames(images_of(scene, exposed), good, noise_of(scene))


# -- exposures of many reads -------------------------------------------------------------------------


@dataclass(frozen=True)
class Read:
    """One read of the detector: exposure [s], noise [e- RMS], excess noise, dark current [e-/s]."""

    exposure_s: float
    noise_e: float
    excess_noise_factor: float
    dark_e_per_s: float

    @classmethod
    def of(cls, instrument: Instrument, noise: NoiseOf, stage: str) -> "Read | None":
        """Return a read of the detector by the profile, or None for exposures of one read.

        `noise` is a setting of `stage`, which the ConfigurationError names where the profile does not know
        its reads.
        """
        if noise == "one_read":
            return None
        known = instrument.defaults
        needed = ("detector.read_s", "detector.read_noise_e")
        missing = [key for key in needed if key not in known]
        if missing:
            raise ConfigurationError(
                f"the profile {instrument.name} gives no {' and '.join(missing)}; set {stage}.noise=one_read"
            )
        read_s, noise_e = (known[key] for key in needed)
        factor = max(1.0, known.get("detector.excess_noise_factor", 0.0))
        return cls(read_s, noise_e, factor, known.get("detector.dark_e_per_s", 0.0))


def as_read(scene: Scene, read: Read | None) -> Scene:
    """Return a `scene` whose exposures have the noise of all their reads, sky and dark; None changes nothing.

    Charges and their multiplication add up, so that N reads have the statistics of a single one of the
    whole exposure, which is √N times noisier; it takes a hundredth of the time to draw.
    """
    if read is None:
        return scene
    reads = max(1, round(scene.exposure_s / read.exposure_s))
    detector = replace(
        scene.detector,
        read_noise_e=float(np.sqrt(reads)) * read.noise_e,
        excess_noise_factor=read.excess_noise_factor,
        dark_e_per_s=read.dark_e_per_s,
    )
    return replace(scene, detector=detector, sky_e_per_s=sky_e_per_s(scene))


def sky_e_per_s(scene: Scene) -> float:
    """Return the light of the sky in a pixel by the profile, for the bands and optics of a `scene`.

    A lenslet has its part of the pupil and of this light.
    """
    photons_per_s_m0 = scene.photons / scene.exposure_s * 10 ** (0.4 * scene.mag_j)
    spectrum = [(band.centre_nm, band.share) for band in scene.bands]
    of_pupil = scene.facility.sky_photons_per_s(spectrum, photons_per_s_m0, scene.pixel_scale_mas)
    return of_pupil / scene.lenslets**2
