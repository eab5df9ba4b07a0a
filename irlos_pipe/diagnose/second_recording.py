"""Which further recording would show what this one cannot.

Fisher matrices need no frames: at the optimum, every recording that might be taken beside the present
ones is computed, with as many frames and as much light, and what is then left of an effect's derivative
beyond the fitted parameters, and of the likeness of two names, tells whether it would help.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.diagnose.ambiguity import likeness
from irlos_pipe.diagnose.cube import Stack, Stacks
from irlos_pipe.diagnose.fitting import Fitted, Fitter
from irlos_pipe.diagnose.optimum import Optimum
from irlos_pipe.diagnose.refit import Refit
from irlos_pipe.diagnose.search.detect import ABSORBED, NOTHING, Score, whitened_shapes
from irlos_pipe.diagnose.sizes import detectable, within_reach
from irlos_pipe.diagnose.view import View
from irlos_pipe.effects import Conditions
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import PsfSettings

OUT_OF_FOCUS_NM = 200.0
BANDS_NM = {"J": (1157.0, 1273.0), "H": (1541.0, 1709.0)}
COLOURS = 3


@dataclass(frozen=True)
class Advice:
    """A further recording that shows an effect.

    Attributes
    ----------
    recording : str
        How it differs from the first.
    survival : float
        Part of the power of the effect's derivative that the fitted parameters cannot imitate then.
    smallest : dict
        Public size that would be seen then.
    """

    recording: str
    survival: float
    smallest: dict[str, Any]


class SecondRecordings:
    """Recordings that might be taken beside those of a diagnosis.

    Parameters
    ----------
    optimum : Optimum
        Of the model as it is at the end.
    """

    def __init__(self, optimum: Optimum):
        self.optimum, self.present = optimum, optimum.stack
        first = optimum.fitted.views[0]
        self.views = {
            words: View(replaced(first.psf, settings), conditions)
            for words, settings, conditions in variants(first.psf.settings, first.conditions)
        }
        self.beside = {words: self._beside(optimum.fitted, words) for words in self.views}

    def showing(self, score: Score, gain: float) -> Advice | None:
        """The recording with which an untestable effect is seen best; None if none shows it.

        Parameters
        ----------
        score : Score
            Of the effect without it.
        gain : float
            Fall of χ² from which it counts as seen.
        """
        found = ((words, self._score(score, optimum)) for words, optimum in self.beside.items())
        useful = [
            (words, one) for words, one in found if one.testable and within_reach(one, gain, plausible=True)
        ]
        if not useful:
            return None
        words, best = max(useful, key=lambda pair: pair[1].survival)
        return Advice(words, best.survival, detectable(best, gain))

    def separating(self, one: Refit, other: Refit) -> tuple[str, float]:
        """The recording with which two names are least alike, and how much they still are."""
        found = {words: self._likeness(words, one, other) for words in self.views}
        words = min(found, key=lambda key: found[key])
        return words, found[words]

    def _score(self, score: Score, optimum: Optimum) -> Score:
        shapes = whitened_shapes(optimum, [score.candidate])[0]
        power, left = (shapes**2).sum(0), torch.diagonal(optimum.norm2(shapes)).clamp_min(1e-300)
        survival = torch.where(power > NOTHING * power.max(), left / power.clamp_min(1e-300), 0.0)
        smallest = torch.where(survival > ABSORBED, left**-0.5, torch.inf).numpy()
        return replace(score, survival=float(survival.max()), smallest=smallest)

    def _likeness(self, words: str, one: Refit, other: Refit) -> float:
        models = (one.fitted, other.fitted, one.origin.fitted)
        first, second, before = (self._beside(fitted, words) for fitted in models)
        return likeness(first.fitted, second.fitted, before)

    def _beside(self, fitted: Fitted, words: str) -> Optimum:
        """A model with one recording more, which shows what it predicts."""
        first, view = self.present.parts[0], self.views[words]
        pair = Fitter([fitted.views[0], view], Stacks((first, first))).at(fitted)
        image_e = pair.image_e[pair.problem.pixels[1]]
        stacks = Stacks((*self.present.parts, _expected(first, image_e)))
        return Optimum(stacks, Fitter([*fitted.views, view], stacks).at(fitted))


def _expected(like: Stack, image_e: torch.Tensor) -> Stack:
    """A recording with as many frames as another one, as noisy beside its photons."""
    noise, frames = like.frames.noise, len(like)
    louder = like.variance_e2 * frames / noise.variance_e2(like.mean_e)
    variance = noise.variance_e2(image_e) / frames * louder[louder.isfinite()].median()
    return Stack(like.frames, like.when, image_e, variance, like.photon_limited)


def replaced(psf: PsfModel, settings: PsfSettings) -> PsfModel:
    """A model of the same modes for other settings."""
    return PsfModel(settings, psf.nolls, device=psf.device, dtype=psf.dtype)


def variants(settings: PsfSettings, conditions: Conditions) -> list[tuple[str, PsfSettings, Conditions]]:
    """Recordings that differ from one by focus, diversity or band."""
    known = settings.known
    focus = {**known.introduced_nm, 4: known.introduced_nm.get(4, 0.0) + OUT_OF_FOCUS_NM}
    defocused = replace(settings, known=replace(known, introduced_nm=focus))
    found = [(f"{OUT_OF_FOCUS_NM:+.0f} nm out of focus", defocused, conditions)]
    if any(known.diversity_nm.values()):
        plain = replace(settings, known=replace(known, diversity_nm={}))
        found.append(("without the diversity", plain, replace(conditions, diversity={})))
    for name, limits in BANDS_NM.items():
        if not any(limits[0] <= nm <= limits[1] for nm, _ in settings.spectrum):
            spectrum = tuple((float(nm), 1.0) for nm in np.linspace(*limits, COLOURS))
            other = replace(settings, spectrum=spectrum), replace(conditions, spectrum=spectrum)
            found.append((f"in the band {name}, {limits[0]:.0f} to {limits[1]:.0f} nm", *other))
    return found
