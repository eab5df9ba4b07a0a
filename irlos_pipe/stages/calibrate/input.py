"""The input of a calibration: frames of recordings and the model of the recipe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.recording import Recording
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.model.colour import colour_warning, with_colour
from irlos_pipe.stages.model.effects import conditions_of, good_pixels, image_effects, model_effects, shown
from irlos_pipe.stages.model.recording_settings import pooled_frames, psf_settings

ROLES = ("ncpa_calibration", "psf", "derotator")


def require_calibration(recordings: Sequence[Recording]) -> None:
    """Raise InputDataError for `recordings` that are no cubes of one static wavefront."""
    for one in recordings:
        if one.acquisition.role not in ROLES:
            raise InputDataError(
                f"{one.name}: its role is {one.acquisition.role}; a calibration takes recordings of role "
                f"{', '.join(ROLES)}: give another one, or correct the role in the side-car"
            )
    introduced_nm = np.unique(np.concatenate([one.introduced_defocus_nm for one in recordings]))
    if len(introduced_nm) > 1:
        raise InputDataError(
            f"{recordings[0].name}: introduced_defocus_nm differs within what is calibrated together "
            f"({introduced_nm[0]:g} to {introduced_nm[-1]:g} nm); a calibration takes frames of one defocus"
        )


@dataclass(frozen=True)
class CubeInput:
    """Frames of recordings taken alike, and their model.

    Attributes
    ----------
    frames : Frames
        Bad pixels that the model lists masked.
    settings : PsfSettings
    effects : list of Effect
    """

    frames: Frames
    settings: PsfSettings
    effects: list[Effect]


def cube_input(ctx: StageContext, recordings: Sequence[Recording], options: CalibrationOptions) -> CubeInput:
    """Return all frames of the `recordings` and the model of the first.

    Parameters
    ----------
    ctx : StageContext
    recordings : sequence of Recording
        Taken alike.
    options : CalibrationOptions
        State the modes, which the model depends on.
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
    return CubeInput(frames, settings, image_effects(effects))
