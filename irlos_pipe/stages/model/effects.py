"""From a recipe to the effects of the model for a recording, and from a calibration to those of another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.effects import CATALOGUE, Conditions, Effect, FixedEffect
from irlos_pipe.effects.pixels import BadPixels, DetectorNonlinearity
from irlos_pipe.effects.seeing_halo import SeeingHalo, in_band_wfe_nm
from irlos_pipe.frames.recording import Recording
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.stages.model.effect_entry import EffectEntry
from irlos_pipe.stages.model.light_path import residual_band, seeing_arcsec
from irlos_pipe.stages.model.section import ModelConfig

REPORTED_NOLL = 30  # SPARTA takes 29 modal offsets


def conditions_of(
    instrument: Instrument, model: ModelConfig, recording: Recording, highest_noll: int = REPORTED_NOLL
) -> Conditions:
    """What effects may start from."""
    acquisition = recording.acquisition
    return Conditions(
        residual_band(instrument, model),
        instrument.facility.residual_law,
        seeing_arcsec(instrument, acquisition),
        dict(acquisition.diversity),
        highest_noll,
        recording.window,
        acquisition.pixel_scale_mas,
        acquisition.spectrum,
        seeing_measured=acquisition.seeing_measured,
        ncpa_law=instrument.facility.ncpa_law,
    )


def model_effects(
    instrument: Instrument, model: ModelConfig, recording: Recording, highest_noll: int = REPORTED_NOLL
) -> list[Effect]:
    """The effects of the recipe's model for one recording, fixed ones pinned.

    Raises
    ------
    ConfigurationError
        If an effect means nothing for this recording.
    """
    conditions = conditions_of(instrument, model, recording, highest_noll)
    return [_effect(entry, conditions, recording.name) for entry in model.entries()]


def _effect(entry: EffectEntry, conditions: Conditions, recording_name: str) -> Effect:
    try:
        effect = _under(entry, conditions, entry.values)
        if not (entry.values or effect.parameters):
            raise ValueError("there is nothing to estimate; give its values")
        if not entry.values:
            return effect
        values = effect.values_of(**entry.values)
    except ValueError as problem:
        raise ConfigurationError(f"model.effects: {entry.name} for {recording_name}: {problem}") from None
    return FixedEffect(effect, values, free=[p.name for p in effect.parameters] if entry.fit else ())


def _under(entry: EffectEntry, conditions: Conditions, public: dict[str, Any]) -> Effect:
    """The effect with the parameters that given public values, or else the recipe's options, ask for."""
    kind = CATALOGUE[entry.name]
    return kind.under(conditions, **entry.options | kind.options_for(**public))


def image_effects(effects: Sequence[Effect]) -> list[Effect]:
    """Those that the model of an image contains: neither masks of pixels nor errors of the focus stage."""
    return [e for e in effects if e.plane != "ramp" and e.name != BadPixels.name]


def good_pixels(effects: Sequence[Effect], window: tuple[int, int]) -> np.ndarray:
    """False for the bad pixels that the model lists, (rows, columns)."""
    masks = [e.base.mask(window) for e in effects if e.name == BadPixels.name]
    return np.all([np.ones(window, bool), *masks], axis=0)


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
    *,
    same_star: bool = False,
) -> dict[str, FixedEffect]:
    """Effects as `calibrate` found them, for a recording taken under another seeing.

    The in-band residual is scaled by the seeing law and the non-linearity keeps its bend per electron;
    the rest is taken as it is. What belongs to the star, its light or the moment stays behind, unless
    the recipe gives it or the recording is of the `same_star`.
    """
    conditions, known = conditions_of(instrument, model, recording), {}
    for entry in model.entries():
        effect = _effect(entry, conditions, recording.name)
        if effect.parameters:
            effect = _measured(product, entry, conditions) if same_star or effect.instrumental else None
            if effect is not None and entry.name == SeeingHalo.name:
                effect = _scaled_with_seeing(effect, conditions.seeing_arcsec, calibration_seeing_arcsec)
        if effect is not None:
            known[entry.name] = effect
    if DetectorNonlinearity.name in known:
        known[DetectorNonlinearity.name] = _bent_as_before(product, known[DetectorNonlinearity.name])
    return known


def _scaled_with_seeing(halo: FixedEffect, now_arcsec: float, then_arcsec: float) -> FixedEffect:
    """The residual under another seeing."""
    now, then = (
        in_band_wfe_nm(halo.base.band, halo.base.law, seeing) for seeing in (now_arcsec, then_arcsec)
    )
    variance, *shape = halo.values
    return FixedEffect(halo.base, [variance * (now / then) ** 2, *shape])


def _bent_as_before(product: Product, bend: FixedEffect) -> FixedEffect:
    """The non-linearity stated at the brightest pixel of the calibration's mean image, before it was bent.

    Of cubes that were reduced one by one, at the mean over their brightest pixels.
    """
    models = [one.value for name, one in product.arrays.items() if name.endswith("model_image_e")]
    brightest_e = float(np.mean([np.max(image) for image in models]))
    return FixedEffect(DetectorNonlinearity(brightest_e / (1 - bend.values[0])), bend.values)


def _measured(product: Product, entry: EffectEntry, conditions: Conditions) -> FixedEffect | None:
    """An effect at the values of a calibration; None where it has none."""
    key = f"effects/{entry.name}"
    if key not in product.arrays or not len(product.arrays[key].value):
        return None
    effect = _under(entry, conditions, product.results.get("effects", {}).get(entry.name, {}))
    return FixedEffect(effect, np.array(product.arrays[key].value, float))
