"""Which single fact, told wrongly, would explain what a fit of one image misses: one linear step each.

Everything that was fitted is fitted again beside the fact, to first order (`score_test`). Where the wavefront
has bent to imitate the fact, the step is too short.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from irlos_pipe.effects import Effect
from irlos_pipe.effects.colour import Anamorphism, PlateScale, Spectrum
from irlos_pipe.effects.detector import BackgroundGradient, DetectorNonlinearity, InterpixelCrosstalk
from irlos_pipe.effects.redrawn_pupil import PupilMisregistration
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.estimate.score_test import LinearEstimate, derivatives, frozen_effects, null_model
from irlos_pipe.optics.psf_settings import PsfSettings

ALIKE = 0.9  # of what the best one explains: others cannot be told from it
WORTH_NAMING = 0.2  # part of the misfit


@dataclass(frozen=True)
class Lacking:
    """What a model seems to lack.

    Attributes
    ----------
    part : float
        Of the misfit, that the best fact would explain.
    text : str
        That fact in words, and those that look alike; empty where none is worth naming.
    """

    part: float
    text: str


def lacking(problem: ImageFit, x: torch.Tensor, excess: float) -> Lacking:
    """Return the facts that would explain most of the misfit of an image.

    Parameters
    ----------
    problem : ImageFit
        One member.
    x : tensor, (1, parameters)
        Its optimum.
    excess : float
        Part of χ² that is misfit: what a model leaves that lacks nothing is the rest.
    """
    null = null_model(problem, x)
    frozen = frozen_effects(problem.model.effects, x[0, problem.layout.effect_values])
    known = {effect.name for effect in problem.model.effects.effects}
    steps = [
        LinearEstimate.of(null, fact, (derivatives(problem, x, frozen, fact) * null.root).mT)
        for fact in _facts(problem.model.psf.settings)
        if fact.name not in known
    ]
    misfit = excess * float(null.residual.square().sum())
    best = max((step.gain for step in steps), default=0.0)
    alike = [step for step in steps if step.gain >= max(ALIKE * best, WORTH_NAMING * misfit)]
    phrases = [step.candidate.phrase(step.candidate.shown(step.sizes)) for step in alike]
    return Lacking(min(best / misfit, 1.0), " or ".join(phrases))


def _facts(settings: PsfSettings) -> list[Effect]:
    return [
        PlateScale(settings.pixel_scale_mas),
        Spectrum(settings.mean_nm),
        Anamorphism(),
        PupilMisregistration(),
        BackgroundGradient(),
        DetectorNonlinearity(),
        InterpixelCrosstalk(),
    ]
