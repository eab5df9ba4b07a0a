"""From a recipe and a recording to the PSF model's settings and effects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from irlos_pipe.effects import CATALOGUE, Conditions, Effect, Pinned, SeeingHalo
from irlos_pipe.effects.seeing_halo import in_band_wfe_nm
from irlos_pipe.errors import ConfigurationError, InputDataError
from irlos_pipe.instrument import Instrument
from irlos_pipe.noise import NoiseModel
from irlos_pipe.optics.propagate import require_resolved
from irlos_pipe.optics.structure import ResidualBand
from irlos_pipe.product import Product, Quantity
from irlos_pipe.psf import PsfSettings
from irlos_pipe.recording import Acquisition, Recording
from irlos_pipe.stages.model import EffectEntry, ModelConfig
from irlos_pipe.stages.recordings import recordings_from_product

DEFAULT_SEEING_ARCSEC = 0.8
REPORTED_NOLL = 30  # SPARTA takes 29 modal offsets
SETUP_KEYS = ("pixel_scale_mas", "spectrum", "diversity")


def psf_settings(
    instrument: Instrument, model: ModelConfig, recording: Recording, ncpa_nm: dict[int, float] | None = None
) -> PsfSettings:
    """Settings of the PSF model for one recording; `ncpa_nm` is added to the diversity.

    Raises
    ------
    ConfigurationError
        If the pupil is sampled too coarsely for the window.
    InputDataError
        If the image is that of one lenslet: the model is that of the full pupil.
    """
    acquisition = recording.acquisition
    if acquisition.subaperture:
        raise InputDataError(
            f"{recording.name}: image {acquisition.subaperture} of a 2x2 mode ({acquisition.mode}); "
            "calibration and LIFT need full-pupil recordings"
        )
    _require_samples(instrument, model, recording)
    diversity = dict(acquisition.diversity)
    for noll, value in (ncpa_nm or {}).items():
        diversity[noll] = diversity.get(noll, 0.0) + value
    return PsfSettings(
        instrument.pupil,
        recording.window,
        acquisition.pixel_scale_mas,
        acquisition.spectrum,
        diversity,
        model.pupil_samples,
    )


def _require_samples(instrument: Instrument, model: ModelConfig, recording: Recording) -> None:
    """Turn the model's refusal of a wide window into an error of the recipe."""
    acquisition, step_m = recording.acquisition, instrument.pupil.diameter_m / model.pupil_samples
    shortest_m = min(wavelength_nm for wavelength_nm, _ in acquisition.spectrum) * 1e-9
    try:
        require_resolved(max(recording.window), acquisition.pixel_scale_mas, shortest_m, step_m)
    except ValueError as problem:
        raise ConfigurationError(
            f"{recording.name}: model.pupil_samples {model.pupil_samples}: {problem}"
        ) from None


def residual_band(instrument: Instrument, model: ModelConfig) -> ResidualBand:
    """Spatial frequencies of the AO residual; below 1/D there is only tip and tilt."""
    return ResidualBand(1 / instrument.pupil.diameter_m, model.cutoff_per_m, model.outer_scale_m)


def seeing_arcsec(acquisition: Acquisition) -> float:
    """Seeing of a recording, or a typical one where it is not known."""
    return acquisition.seeing_arcsec or DEFAULT_SEEING_ARCSEC


def conditions_of(
    instrument: Instrument, model: ModelConfig, recording: Recording, highest_noll: int = REPORTED_NOLL
) -> Conditions:
    """What effects may start from."""
    acquisition = recording.acquisition
    return Conditions(
        residual_band(instrument, model),
        seeing_arcsec(acquisition),
        dict(acquisition.diversity),
        highest_noll,
        recording.window,
        acquisition.pixel_scale_mas,
        acquisition.spectrum,
    )


def model_effects(
    instrument: Instrument, model: ModelConfig, recording: Recording, highest_noll: int = REPORTED_NOLL
) -> list[Effect | Pinned]:
    """The effects of the recipe's model for one recording, fixed ones pinned.

    Raises
    ------
    ConfigurationError
        If an effect means nothing for this recording.
    """
    conditions = conditions_of(instrument, model, recording, highest_noll)
    return [_effect(entry, conditions, recording.name) for entry in model.entries()]


def _effect(entry: EffectEntry, conditions: Conditions, recording_name: str) -> Effect | Pinned:
    kind = CATALOGUE[entry.name]
    try:
        effect = kind.under(conditions, **kind.options_for(**entry.values) | entry.options)
        if not entry.values:
            return effect
        values = effect.values_of(**entry.values)
    except ValueError as problem:
        raise ConfigurationError(f"model.effects: {entry.name} for {recording_name}: {problem}") from None
    return Pinned(effect, values, free=[p.name for p in effect.parameters] if entry.fit else ())


# -- handing estimated effects from one product to the next ------------------------------------


def effect_arrays(effect_values: dict[str, np.ndarray]) -> dict[str, Quantity]:
    """Solver's parameters of every effect as arrays of a product."""
    return {
        f"effects/{name}": Quantity(values, "", "parameters of the effect, in the order of its declaration")
        for name, values in effect_values.items()
    }


def calibrated_effects(
    product: Product,
    instrument: Instrument,
    model: ModelConfig,
    recording: Recording,
    calibration_seeing_arcsec: float,
) -> dict[str, Pinned]:
    """Effects as `calibrate` found them, for a recording taken under another seeing.

    The in-band residual is scaled by the seeing law; the rest is taken as it is.
    """
    effects = {effect.name: effect for effect in model_effects(instrument, model, recording)}
    pinned = {}
    for name, effect in effects.items():
        key = f"effects/{name}"
        if isinstance(effect, Pinned):
            pinned[name] = effect
        elif key in product.arrays:
            values = np.array(product.arrays[key].value, float)
            if name == SeeingHalo.name:
                now, then = (
                    in_band_wfe_nm(effect.band, seeing)
                    for seeing in (seeing_arcsec(recording.acquisition), calibration_seeing_arcsec)
                )
                values[0] *= (now / then) ** 2
            pinned[name] = Pinned(effect, values)
    return pinned


# -- recordings that belong together -----------------------------------------------------------


def require_one_setup(recordings: Sequence[Recording]) -> None:
    """Raise InputDataError unless all recordings share window, pixel scale, spectrum and diversity."""
    first = recordings[0]
    for other in recordings[1:]:
        differing = [
            key for key in SETUP_KEYS if getattr(other.acquisition, key) != getattr(first.acquisition, key)
        ]
        if other.window != first.window:
            differing.append("window")
        if differing:
            raise InputDataError(
                f"{other.name}: {', '.join(differing)} differ from those of {first.name}; "
                "reduce recordings of different set-ups separately"
            )


def used_in_time_order(ingest: Product, input_name: str) -> list[Recording]:
    """Used frames of a recipe input's recordings, which must share one set-up, in order of time."""
    recordings = [r.accepted() for r in in_time_order(recordings_from_product(ingest, input_name))]
    require_one_setup(recordings)
    return recordings


def pooled_images(recordings: Sequence[Recording]) -> tuple[torch.Tensor, torch.Tensor, NoiseModel]:
    """Frames of all recordings one after the other, pixels good in all of them, and their noise."""
    return (
        torch.as_tensor(np.concatenate([r.images_e for r in recordings])),
        torch.as_tensor(np.all([r.pixel_mask for r in recordings], axis=0)),
        NoiseModel.of(recordings[0]),
    )


def in_time_order(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings by time of their first frame where all have one, else in the order given."""
    starts = [recording.start_unix_s for recording in recordings]
    return (
        sorted(recordings, key=lambda r: r.start_unix_s) if np.all(np.isfinite(starts)) else list(recordings)
    )
