"""Which further recording would show what this one cannot.

Fisher matrices need no frames: at the optimum, every recording that might be taken in addition is computed,
with as many frames and as much light, and what is then left of an effect's derivative beyond the fitted
parameters, and of the likeness of two names, says whether it would help.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from irlos_pipe.conventions.bands import H, J
from irlos_pipe.diagnosis.acceptance import Comparison, likeness
from irlos_pipe.diagnosis.cube import Stack, Stacks
from irlos_pipe.diagnosis.effect_sizes import detectable, within_reach
from irlos_pipe.diagnosis.fitting import Fitted, Fitter
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import Advice
from irlos_pipe.diagnosis.scores import Score, whitened_shapes
from irlos_pipe.diagnosis.view import View
from irlos_pipe.effects import Conditions
from irlos_pipe.estimate.score_test import ABSORBED, MEANINGLESS
from irlos_pipe.numerics.parallel import ordered_map

OUT_OF_FOCUS_NM = 200.0  # defocus of a further recording
BANDS = {"J": J, "H": H}
COLOURS = 3  # wavelengths of a further recording's band


class SecondRecordings:
    """Recordings that might be taken in addition to those of a diagnosis, at its final optimum."""

    def __init__(self, optimum: Optimum):
        self.present = optimum.stack
        self.known = [_rough(view) for view in optimum.fitted.views]
        first = optimum.fitted.views[0]
        self.views = {
            recording: _rough(first.under(conditions)) for recording, conditions in variants(first.conditions)
        }
        beside = ordered_map(partial(self._with_recording, optimum.fitted), self.views)
        self.beside = dict(zip(self.views, beside, strict=True))

    def showing(self, score: Score) -> Advice | None:
        """The recording with which an untestable effect is seen best; None if none shows it."""
        found = ((recording, self._score(score, optimum)) for recording, optimum in self.beside.items())
        useful = [
            (recording, one) for recording, one in found if one.testable and within_reach(one, plausible=True)
        ]
        if not useful:
            return None
        recording, best = max(useful, key=lambda pair: pair[1].observability)
        return Advice(recording, best.observability, detectable(best))

    def separating(self, one: Comparison, others: Sequence[Comparison]) -> list[tuple[str, float]]:
        """For each of the `others` the recording with which it is least like `one`, and how much it still is.

        All are from the same origin.
        """
        if not others:
            return []

        def likenesses(recording: str) -> list[float]:
            before = self._with_recording(one.origin.fitted, recording)
            first, *rest = (self._model(fit.fitted, recording)[0] for fit in (one, *others))
            return [likeness(first, other, before) for other in rest]

        rows = ordered_map(likenesses, self.views)
        return [
            min(zip(self.views, row, strict=True), key=lambda pair: pair[1])
            for row in zip(*rows, strict=True)
        ]

    def _score(self, score: Score, optimum: Optimum) -> Score:
        shapes = whitened_shapes(optimum, [score.candidate])[0]
        power, left = (shapes**2).sum(0), torch.diagonal(optimum.norm2(shapes)).clamp_min(1e-300)
        seen = torch.where(power > MEANINGLESS * power.max(), left / power.clamp_min(1e-300), 0.0)
        smallest = torch.where(seen > ABSORBED, left**-0.5, torch.inf).numpy()
        return replace(score, observability=float(seen.max()), smallest=smallest)

    def _with_recording(self, fitted: Fitted, recording: str) -> Optimum:
        """A model with one recording more, which shows what it predicts."""
        model, stacks = self._model(fitted, recording)
        return Optimum(stacks, model)

    def _model(self, fitted: Fitted, recording: str) -> tuple[Fitted, Stacks]:
        """The same without its derivatives, and what the recordings show."""
        first, view = self.present.parts[0], self.views[recording]
        pair = Fitter([self.known[0], view], replace(self.present, parts=(first, first))).at(fitted)
        image_e = pair.image_e[pair.problem.pixels[1]]
        stacks = replace(self.present, parts=(*self.present.parts, _expected(first, image_e)))
        return Fitter([*self.known, view], stacks).at(fitted), stacks


def _rough(view: View) -> View:
    return view.with_modes(view.psf.nolls, few_colours=True)


def _expected(like: Stack, image_e: torch.Tensor) -> Stack:
    """A recording with as many frames as another one, noisier than its noise model by the same factor."""
    noise, frames = like.frames.noise, len(like)
    louder = like.variance_e2 * frames / noise.variance_e2(like.mean_e)
    variance = noise.variance_e2(image_e) / frames * louder[louder.isfinite()].median()
    return replace(like, mean_e=image_e, variance_e2=variance)


def variants(conditions: Conditions) -> list[tuple[str, Conditions]]:
    """Recordings that differ from one taken under `conditions` by focus, diversity or band."""
    settings, known = conditions.settings, conditions.settings.known
    focus = {**known.introduced_nm, 4: known.introduced_nm.get(4, 0.0) + OUT_OF_FOCUS_NM}
    found = [(f"{OUT_OF_FOCUS_NM:+.0f} nm out of focus", replace(known, introduced_nm=focus))]
    if any(known.diversity_nm.values()):
        found.append(("without the diversity", replace(known, diversity_nm={})))
    others = [(recording, replace(settings, known=one)) for recording, one in found]
    for name, limits in ((name, band.limits_nm) for name, band in BANDS.items()):
        if not any(limits[0] <= nm <= limits[1] for nm, _ in settings.spectrum):
            spectrum = tuple((float(nm), 1.0) for nm in np.linspace(*limits, COLOURS))
            recording = f"in the band {name}, {limits[0]:.0f} to {limits[1]:.0f} nm"
            others.append((recording, replace(settings, spectrum=spectrum)))
    return [(recording, replace(conditions, settings=one)) for recording, one in others]
