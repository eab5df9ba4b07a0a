"""From a recipe and a recording to the PSF model's settings, and recordings that belong together."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.pupil_drawing import turned
from irlos_pipe.conventions.units import NM
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.planes import LensEffect
from irlos_pipe.estimate.cube import Frames, steadied
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Acquisition, Recording
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.optics.fourier_matrices import require_resolved
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.product.product import Product
from irlos_pipe.stages.ingest.recording_arrays import recordings_from_product
from irlos_pipe.stages.model.groups import require_one_setup
from irlos_pipe.stages.model.section import ModelConfig


def psf_settings(
    instrument: Instrument,
    model: ModelConfig,
    recording: Recording,
    *,
    introduced_nm: Mapping[int, float] | None = None,
    ncpa_nm: Mapping[int, float] | None = None,
) -> PsfSettings:
    """Settings of the PSF model for one recording, whose diversity belongs to the known wavefront.

    `introduced_nm` is what was introduced in addition to the diversity, `ncpa_nm` are NCPAs to hold, see
    `KnownWavefront`. Raises `ConfigurationError` if the pupil is sampled too coarsely for the window.
    """
    acquisition = recording.acquisition
    settings = PsfSettings(
        turned(instrument.pupil, acquisition.pupil_rotation_deg),
        recording.window,
        acquisition.pixel_scale_mas,
        acquisition.spectrum,
        KnownWavefront(acquisition.diversity, introduced_nm or {}, ncpa_nm or {}),
        model.pupil_samples,
        lenslets=acquisition.lenslets,
    ).for_broad_images()
    if acquisition.lenslets > 1:
        settings = replace(settings, pupil_samples=max(settings.pupil_samples, settings.needed_samples))
    else:
        _require_samples(instrument, model, recording)
    for entry in model.entries():
        kind = CATALOGUE[entry.name]
        if issubclass(kind, LensEffect):  # without values it has the aperture of the profile
            effect = kind(instrument.facility.numerical_aperture)
            start = [one.start for one in effect.parameters]
            values = effect.values_of(**entry.values) if entry.values else start
            settings = effect.apply(torch.tensor(values, dtype=torch.float64), settings)
    return settings


def _require_samples(instrument: Instrument, model: ModelConfig, recording: Recording) -> None:
    """Turn the model's refusal of a wide window into an error of the recipe."""
    acquisition, step_m = recording.acquisition, instrument.pupil.diameter_m / model.pupil_samples
    shortest_m = min(wavelength_nm for wavelength_nm, _ in acquisition.spectrum) * NM
    try:
        require_resolved(max(recording.window), acquisition.pixel_scale_mas, shortest_m, step_m)
    except ValueError as problem:
        raise ConfigurationError(
            f"{recording.name}: model.pupil_samples {model.pupil_samples}: {problem}"
        ) from None


def residual_band(instrument: Instrument, model: ModelConfig) -> ResidualBand:
    """Return the frequencies of the AO residual of an `instrument`; `model` may change them.

    Below 1/D there is only tip and tilt.
    """
    facility = instrument.facility
    return ResidualBand(
        1 / facility.pupil.diameter_m,
        model.cutoff_per_m or facility.cutoff_per_m,
        model.outer_scale_m or facility.outer_scale_m,
    )


def seeing_arcsec(instrument: Instrument, acquisition: Acquisition) -> float:
    """Return the seeing of a recording's `acquisition`, or the `instrument`'s typical one."""
    return acquisition.seeing_arcsec or instrument.facility.typical_seeing_arcsec


# -- recordings that belong together -----------------------------------------------------------


def used_in_time_order(ingest: Product, input_name: str) -> list[Recording]:
    """Return the used frames of the input `input_name` of `ingest`, in order of time, of one set-up."""
    recordings = [r.accepted() for r in in_time_order(recordings_from_product(ingest, input_name))]
    require_one_setup(recordings)
    return recordings


def pooled_frames(
    recordings: Sequence[Recording], listed: np.ndarray, settings: PsfSettings, *, steady: bool = True
) -> Frames:
    """Return the frames of recordings of one set-up; `steady` takes out the motion of a star that moves.

    `listed`, (rows, columns), are the pixels that are good by the model. Raises `InputDataError` without a
    frame.
    """
    images_e, good, noise = pooled_images(recordings)
    if not len(images_e):
        raise InputDataError(f"{recordings[0].name}: no used frame is left")
    good = good & torch.as_tensor(listed)
    if not steady or settings.lenslets > 1:
        return Frames(images_e, good, noise)
    still_e, seen, motion = steadied(images_e.numpy(), good.numpy(), noise, settings.resolution_px)
    return Frames(torch.as_tensor(still_e), torch.as_tensor(seen), noise, motion=motion)


def pooled_images(recordings: Sequence[Recording]) -> tuple[torch.Tensor, torch.Tensor, NoiseModel]:
    """Frames of all recordings one after the other, pixels good in all of them, and their mean noise."""
    images = [r.images_e for r in recordings]  # those of a single recording are not copied
    return (
        torch.as_tensor(images[0] if len(images) == 1 else np.concatenate(images)),
        torch.as_tensor(np.all([r.good for r in recordings], axis=0)),
        NoiseModel.pooled(recordings),
    )


def in_time_order(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings by time of their first frame where all have one, else in the order given."""
    starts = [recording.start_unix_s for recording in recordings]
    return (
        sorted(recordings, key=lambda r: r.start_unix_s) if np.all(np.isfinite(starts)) else list(recordings)
    )
