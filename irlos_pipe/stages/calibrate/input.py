"""The input of a calibration: frames and the model of the recipe, for one set-up or several."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects import Conditions, Effect
from irlos_pipe.effects.wavefront import FilterNcpa
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.setups import Setup, is_common
from irlos_pipe.frames.recording import Recording
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.model.effects import (
    colour_warning,
    conditions_of,
    good_pixels,
    image_effects,
    model_effects,
    shown,
    with_colour,
)
from irlos_pipe.stages.model.recording_settings import pooled_frames, psf_settings


@dataclass(frozen=True)
class CubeInput:
    """Frames of recordings of one set-up, and their model."""

    frames: Frames  # bad pixels that the model lists are masked
    settings: PsfSettings
    effects: list[Effect]
    conditions: Conditions


def cube_input(ctx: StageContext, recordings: Sequence[Recording], options: CalibrationOptions) -> CubeInput:
    """Return all frames of `recordings` of one set-up and the model of the first; `options` state its modes.

    `ctx` has the instrument and the section `model` of the recipe.
    """
    first, highest_noll = recordings[0], options.last_noll
    conditions = conditions_of(ctx.instrument, ctx.model, first, highest_noll)
    effects = shown(model_effects(ctx.instrument, ctx.model, first, highest_noll), [conditions])
    effects = with_colour(effects, ctx.model, conditions)
    if warning := colour_warning(effects, recordings):
        ctx.log.warning(warning)
    introduced_nm = {DEFOCUS: float(first.introduced_defocus_nm[0])}
    settings = psf_settings(ctx.instrument, ctx.model, first, introduced_nm=introduced_nm)
    steady = METHODS[options.method].effects
    frames = pooled_frames(recordings, good_pixels(effects, first.window), settings, steady=steady)
    return CubeInput(frames, settings, image_effects(effects), replace(conditions, settings=settings))


# -- recordings in several set-ups, calibrated together ----------------------------------------------


def setups_of(
    ctx: StageContext, groups: Sequence[Sequence[Recording]], options: CalibrationOptions
) -> list[Setup]:
    """Return what `calibrate_setups` needs with `options` of `groups`, see `by_setup`; `ctx` as above."""
    highest_noll = options.last_noll
    reference_nm = groups[0][0].acquisition.wavelength_nm
    conditions = [
        conditions_of(
            ctx.instrument,
            ctx.model,
            one,
            highest_noll,
            introduced_nm={DEFOCUS: float(one.introduced_defocus_nm[0])} if one.frames else {},
            ncpa_wavelength_nm=reference_nm,
        )
        for one, *_ in groups
    ]
    first = model_effects(
        ctx.instrument, ctx.model, groups[0][0], highest_noll, ncpa_wavelength_nm=reference_nm
    )
    # Recordings of known focus show the focus of a filter or lens.
    common = [
        effect.with_focus() if isinstance(effect, FilterNcpa) else effect
        for effect in image_effects(shown(first, conditions))
        if is_common(effect)
    ]
    found = []
    for group, under in zip(groups, conditions, strict=True):
        listed = model_effects(ctx.instrument, ctx.model, group[0], highest_noll)
        own = [e for e in image_effects(with_colour(listed, ctx.model, under)) if not is_common(e)]
        if warning := colour_warning(own, group):
            ctx.log.warning(warning)
        frames = pooled_frames(group, good_pixels(listed, group[0].window), under.settings)
        shared = [effect.seen_in(under, conditions[0]) for effect in common]
        found.append(Setup(frames, under.settings, shared, own, tuple(one.name for one in group)))
    return found
