"""Dispersion and the colour of the star: in the model of every broad band on sky unless a recipe says no."""

from __future__ import annotations

from collections.abc import Sequence

from irlos_pipe.conventions.text import and_more
from irlos_pipe.effects import Conditions, Effect, FixedEffect, SeeingHalo
from irlos_pipe.effects.colour import AtmosphericDispersion, Spectrum
from irlos_pipe.frames.recording import Recording
from irlos_pipe.stages.model.section import ModelConfig

BROAD = 0.05  # width of a band, of its mean wavelength, in which colours matter
COST = (
    "100 mas/um that no model knows move the defocus by 20 to 70 nm, and what is found from the images "
    "instead is less certain on faint stars"
)


def with_colour(effects: Sequence[Effect], model: ModelConfig, conditions: Conditions) -> list[Effect]:
    """Return the `effects` of a recipe's `model` with dispersion and the colour of the star, both free.

    Only where the band is broad, and on sky, that is with an AO residual; what the recipe lists itself stays
    as it is.

    Parameters
    ----------
    effects : sequence of Effect
    model : ModelConfig
    conditions : Conditions
        Of the recording.
    """
    if not wants_colour(effects, model, conditions):
        return list(effects)
    own = [AtmosphericDispersion.under(conditions), star_colour(conditions)]
    listed = {effect.name for effect in effects}
    return [*effects, *(effect for effect in own if effect.name not in listed)]


def wants_colour(effects: Sequence[Effect], model: ModelConfig, conditions: Conditions) -> bool:
    """Whether colours belong to `effects` of a `model` under `conditions`, see `with_colour`."""
    settings = conditions.settings
    on_sky = any(effect.name == SeeingHalo.name for effect in effects)
    return model.colour == "auto" and on_sky and settings.span_nm > BROAD * settings.mean_nm


def star_colour(conditions: Conditions) -> FixedEffect:
    """Return the `spectrum` under `conditions`, its slope alone free: a star redder or bluer than stated."""
    effect = Spectrum.under(conditions)
    null = [parameter.start for parameter in effect.parameters]
    return FixedEffect(effect, null, free=["slope_per_um"])


def colour_warning(effects: Sequence[Effect], recordings: Sequence[Recording]) -> str:
    """Return the warning that a model with free dispersion lacks an altitude; empty if it lacks none.

    Parameters
    ----------
    effects : sequence of Effect
        Of the model of the recordings.
    recordings : sequence of Recording
    """
    free = any(effect.name == AtmosphericDispersion.name and effect.parameters for effect in effects)
    unknown = [one.name for one in recordings if one.acquisition.altitude_deg is None]
    if not (free and unknown):
        return ""
    named = unknown[0] + and_more(unknown)
    return f"{named}: altitude_deg is not known, so atmospheric dispersion starts from none: {COST}"
