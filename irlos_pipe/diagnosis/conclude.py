"""From what a search found to the verdict, and to the search log of effects that are not named."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.diagnosis.acceptance import Accepted, HeldOutEvaluation, Search, gap_between
from irlos_pipe.diagnosis.checks.drift import motion_ratio
from irlos_pipe.diagnosis.checks.fine_structure import fine_structure, flat_rms
from irlos_pipe.diagnosis.checks.noise import NoiseVerdict
from irlos_pipe.diagnosis.checks.pixels import screened_step, smallest_excess
from irlos_pipe.diagnosis.cube import Cube
from irlos_pipe.diagnosis.effect_sizes import Covariances, detectable, within_reach
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.grade import judged, share_at_its_place
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.records import Advice, Ranked
from irlos_pipe.diagnosis.scores import Score
from irlos_pipe.diagnosis.second_recording import SecondRecordings
from irlos_pipe.diagnosis.verdict import (
    COMPLETE,
    EFFECT,
    NONE,
    PARTIAL,
    UNKNOWN,
    Adjusted,
    Diagnosis,
    Outcome,
    Pictures,
    Step,
    Tried,
    rest_of,
)
from irlos_pipe.diagnosis.view import Screened
from irlos_pipe.effects import CATALOGUE, Effect, FixedEffect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.public_values import public_sigma
from irlos_pipe.estimate.effect_modes import effects_in_modes_nm

HALF_CLEAR = 0.5  # part of the full amplitude from which the pupil is clear


def conclude(
    cube: Cube,
    search: Search,
    noise: NoiseVerdict,
    options: Options,
    screened: Sequence[Screened] = (),
) -> Diagnosis:
    """The verdict with all its numbers; `screened` pixels were masked in the frames."""
    plain = search.final.under(search.null.stack)
    fine = fine_structure(plain)
    before, after = (HeldOutEvaluation(cube.held_out, one.fitted) for one in (search.null, plain))
    gap = gap_between(cube.held_out, search.null.fitted, plain.fitted)
    judgement = judged(search, noise, fine, gap, options)
    search, why = judgement.search, judgement.why_unknown
    covariances = Covariances(search.final.stack, search.final.fitted)
    steps = [*_drift_steps(cube, search, options), *_steps(search, judgement.shares, covariances)]
    final, after = (search.null, before) if why else (plain, after)
    left_fine = fine_structure(search.null) if why else fine
    flat = 0.0 if why or fine.significance < options.sure else _flat_rms(final)
    gap = replace(gap, after=after.gap)
    present = {effect.name for effect in search.final.fitted.effects}
    unseen = [s for s in search.scores if s.name not in present]
    testable = [s for s in unseen if s.testable and within_reach(s)]
    hidden = [s for s in unseen if s not in testable]
    seconds = SecondRecordings(search.final)
    steps = [_with_separation(step, search, seconds) for step in steps]
    known = steps if not why else []
    frames = len({*cube.training.parts[0].when, *cube.held_out.parts[0].when})
    pixels = screened_step(screened, final, frames, gap)
    if pixels is not None:
        known, gap = _before_ordinary(known, pixels), replace(gap, before=pixels.gap.before)
    left = judgement.left or fine.significance > options.sure
    return Diagnosis(
        verdict=UNKNOWN if why else EFFECT if known else NONE,
        grade=judgement.grade if why or not known else PARTIAL if left else COMPLETE,
        steps=known,
        nearest=(steps[0] if steps else _nearest(search)) if why else None,
        unexplained=bool(why) or left,
        why_unknown=why,
        adjusted=_adjusted(search, covariances) if not why else [],
        tried=tried(search, options, hidden, named=not why),
        rest=rest_of(after, gap.floor, left_fine, options.sure, final.settings, flat),
        gap=gap,
        mdb=_with_wider_forms({s.name: _smallest(s) for s in testable}) | _elsewhere(search, options),
        untestable=[*(s.name for s in hidden), *search.meaningless],
        advice=_advice(hidden, seconds),
        noise=noise,
        fine=fine,
        chi2_nu=(search.null.excess.chi2_nu, plain.excess.chi2_nu),
        excess_sigma=(search.null.excess.significance, plain.excess.significance),
        motion_ratio=motion_ratio(cube.training, search.final.fitted),
        drift_significance=search.drift.significance if search.drift else float("nan"),
        frames=cube.frames,
        held_out=cube.training.held_out,
        nolls=final.fitted.problem.layout.nolls,
        modes_nm=_both(total_modes_nm(search.null.fitted), total_modes_nm(final.fitted)),
        modes_sigma_nm=(Covariances(final.stack, final.fitted) if why else covariances).modes_sigma_nm(),
        pictures=_pictures((before, after), search.null, final),
    )


def _both(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients before and after, of the modes of the latter."""
    return np.pad(before, (0, len(after) - len(before))), after


def total_modes_nm(fitted: Fitted) -> np.ndarray:
    """Coefficients of the whole static wavefront of the first recording, effects in the pupil included."""
    part, x = fitted.recordings[0]
    added = effects_in_modes_nm(part.model.effects, x[0, part.layout.effect_values], part.layout.nolls)[0]
    return x[0, part.layout.modes].numpy() + added.numpy()


def _smallest(score: Score) -> dict:
    """Public size of every parameter that would surely have been seen."""
    found = (detectable(one) for one in (*score.besides, score))
    return {key: size for public in found for key, size in public.items()}


def _flat_rms(final: Optimum) -> float:
    """Error of the flat that would leave the fine structure of the first recording."""
    part, pixels = final.stack.parts[0], final.fitted.problem.pixels[0]
    return flat_rms(part, part.mean_e - final.fitted.image_e[pixels], final.settings)


def _with_wider_forms(smallest: dict[str, dict]) -> dict[str, dict]:
    """`smallest` detectable sizes, and those of wider forms of the effects, degenerate with them at best."""
    wider = {name: kind.widens for name, kind in CATALOGUE.items() if kind.widens in smallest}
    return smallest | {name: smallest[narrower] for name, narrower in wider.items()}


def _elsewhere(search: Search, options: Options) -> dict[str, dict]:
    """Smallest detectable drift and excess of bad pixels; these two have no score test."""
    limits = {}
    if search.drift and search.drift.significance < options.sure:
        drift = search.drift.effect().base
        limits[drift.name] = drift.describe(search.drift.detectable_nm(options.sure))
    if not any(one.refit.effect.found_by == "pixels" for one in search.accepted):
        limits |= smallest_excess(search.final)
    return limits


def _advice(hidden: Sequence[Score], seconds: SecondRecordings) -> dict[str, Advice]:
    """A second recording for every effect that these data hide, where one helps."""
    found = ((score.name, seconds.showing(score)) for score in hidden)
    return {name: advice for name, advice in found if advice is not None}


def _with_separation(step: Step, search: Search, seconds: SecondRecordings) -> Step:
    """`step` with the second recordings that distinguish its alternatives from it best."""
    advised = [
        pair
        for one in search.accepted
        if one.label == step.label
        for pair in seconds.separating(one.refit, one.rivals)
    ]
    alternatives = [
        replace(other, second_recording=recording, likeness_then=cosine)
        for other, (recording, cosine) in zip(step.alternatives, advised, strict=True)
    ]
    return replace(step, alternatives=alternatives)


def _adjusted(search: Search, covariances: Covariances) -> list[Adjusted]:
    """Effects that make the final model fit better and are not named, as it has them."""
    fitted = search.final.fitted
    labels = [label for label in fitted.problem.effects.labels if label in search.adjusted]
    found = []
    for label in labels:
        base, values = fitted.effect(label).base, fitted.values_of(label)
        full = covariances.of(label)
        sizes = _sizes(base, values, full)
        found.append(Adjusted(**sizes, label=label, significance=_apart(base, values, full)))
    return found


def _apart(effect: Effect, values: np.ndarray, covariance: np.ndarray) -> float:
    """Distance of the parameter that is most off from its null, in standard errors; 0 without any null."""
    pairs = zip(effect.parameters, values, np.diag(covariance) ** 0.5, strict=True)
    return max(
        (abs(value - p.null) / s for p, value, s in pairs if p.null is not None and s > 0), default=0.0
    )


# -- names -------------------------------------------------------------------------------------


def _steps(search: Search, shares: Sequence[float], covariances: Covariances) -> list[Step]:
    fitted = search.final.fitted
    rows = zip(search.accepted, shares, strict=True)
    return [replace(_step(one, fitted, covariances.of(one.label)), share=share) for one, share in rows]


def _before_ordinary(steps: Sequence[Step], one: Step) -> list[Step]:
    """`steps` and another one, which comes before what is to be expected of any instrument."""
    usual = [step.effect.base.ordinary(step.effect.values) for step in steps]
    place = usual.index(True) if any(usual) else len(steps)
    return [*steps[:place], one, *steps[place:]]


def _nearest(search: Search) -> Step | None:
    """What came nearest where nothing was named, as the model had it in which it was found."""
    if search.nearest is None:
        return None
    refit = search.nearest.refit
    covariance = Covariances(refit.optimum.stack, refit.fitted).of(refit.label)
    step = _step(search.nearest, refit.fitted, covariance)
    return replace(step, share=share_at_its_place(refit, refit.optimum))


def _step(accepted: Accepted, fitted: Fitted, covariance: np.ndarray) -> Step:
    refit = accepted.refit
    base, values = refit.base, fitted.values_of(accepted.label)
    return Step(
        **_sizes(base, values, covariance),
        significance=refit.significance,
        explained=accepted.ranking[0].explained,
        preference=accepted.preference,
        gap=accepted.gap,
        alternatives=accepted.alternatives,
        ranking=accepted.ranking,
        label=accepted.label,
    )


def _sizes(base: Effect, values: np.ndarray, covariance: np.ndarray) -> dict[str, Any]:
    """An effect with its sizes and errors, as the fields of `Sized`."""
    return {
        "effect": FixedEffect(base, values),
        "public": base.describe(values),
        "sigma": public_sigma(base, values, covariance),
        "shown": base.shown(values),
        "shown_sigma": public_sigma(base, values, covariance, shown=True),
    }


def _drift_steps(cube: Cube, search: Search, options: Options) -> list[Step]:
    drift = search.drift
    if drift is None or drift.significance < options.sure:
        return []
    effect = drift.effect()
    sigma = effect.base.describe(drift.sigma_nm)
    return [
        Step(
            effect,
            effect.describe(np.zeros(0)),
            sigma,
            drift.significance,
            float("nan"),
            float("nan"),
            gap_between(cube.held_out, search.null.fitted, search.null.fitted),
        )
    ]


# -- pictures ----------------------------------------------------------------------------------


def _pictures(judges: Sequence[HeldOutEvaluation], null: Optimum, final: Optimum) -> Pictures:
    stack, shape = judges[0].stack.parts[0], final.fitted.problem.window
    first = final.fitted.problem.pixels[0]
    deviations = final.deviations - (final.deviations @ final.basis) @ final.basis.mT
    _, size, modes = torch.linalg.svd(deviations, full_matrices=False)
    leading = modes[0, first] * size[0] / np.sqrt(len(deviations) * len(final.stack))
    firsts = [optimum.fitted.recordings[0] for optimum in (null, final)]
    models = [part.model for part, _ in firsts]
    values = [x[0, part.layout.effect_values] for part, x in firsts]
    opds = [m.effects.opd_nm(v).numpy() for m, v in zip(models, values, strict=True)]
    before, after = (judge.mean_e[first].reshape(shape).numpy() for judge in judges)
    return Pictures(
        measured_e=stack.mean_e.reshape(shape).numpy(),
        sigma_e=stack.variance_e2.sqrt().reshape(shape).numpy(),
        before_e=before,
        after_e=after,
        leading=leading.reshape(shape).numpy(),
        added_opd_nm=np.where(_clear(models[1]), opds[1] - opds[0], np.nan),
        added_amplitude=_amplitude(models[1], values[1]) - _amplitude(models[0], values[0]),
    )


def _clear(model: ImageModel) -> np.ndarray:
    """Where the pupil as declared is clear, (n, n)."""
    grid = model.psf.grids.pupil
    return grid.amplitude > HALF_CLEAR * grid.light


def _amplitude(model: ImageModel, values: torch.Tensor) -> np.ndarray:
    """Amplitude in the pupil, 1 where it is clear, (n, n)."""
    grid = model.psf.grids.pupil
    pupil = model.effects(values).pupil
    field = grid.amplitude if pupil is None else pupil[0].numpy()
    return np.abs(field) / grid.light


ELSEWHERE = {
    "frames": "sought in the estimates of single frames, and not significant there",
    "noise": "belongs to the noise of the frames, in which no diagnosis looks for patterns",
    "pixels": "sought pixel by pixel, and not found",
    "ramp": "acts on the introduced defocus: only a ramp shows it",
}


def tried(search: Search, options: Options, hidden: Sequence[Score], *, named: bool) -> list[Tried]:
    """Return every effect of the catalogue with what became of it, in the order of the catalogue.

    The free parameters absorb the `hidden`, or they would be seen only beyond their bounds. What was accepted
    is `named`, or else it is what comes nearest.
    """
    story = _Story(search, options, [one.name for one in hidden], named)
    return [story.of(name) for name in CATALOGUE]


@dataclass(frozen=True)
class _Story:
    search: Search
    options: Options
    hidden: Sequence[str]
    named: bool

    def of(self, name: str) -> Tried:
        """What became of one effect."""
        score = next((one for one in self.search.scores if one.name == name), None)
        outcome, reason = self._fate(name, score)
        return Tried(name, outcome, float("nan") if score is None else score.significance, reason)

    def _fate(self, name: str, score: Score | None) -> tuple[Outcome, str]:
        if name in [*(one.name for one in self.search.accepted), *self._drifting()]:
            return ("named", "") if self.named else ("nearest", "fitted, and leaves too much to be named")
        if any(effect.name == name for effect in self.search.null.fitted.effects):
            return "modelled", "in the model from the start"
        if any(effect.name == name for effect in self.search.final.fitted.effects):
            return "adjusted", "the model fits better with it, but it is not sure enough to be named"
        for one in self.search.accepted:
            for other in one.ranking[1:]:
                if other.name == name:
                    return "fitted", _lost(one, other)
        if score is not None:
            return self._scored(score)
        return "not tried", self._not_tried(name)

    def _drifting(self) -> list[str]:
        """Name of the drift, if it is significant."""
        drift = self.search.drift
        return [drift.effect().name] if drift and drift.significance > self.options.sure else []

    def _scored(self, score: Score) -> tuple[Outcome, str]:
        if score.name in self.hidden:
            part = score.observability
            return "absorbed", f"the free parameters imitate all but {part:.1%} of what it does to the image"
        sure, seen = self.options.sure, f"{max(score.significance, 0.0):.1f} σ in what is left"
        if score.significance > sure:
            return "scored", f"{seen}; fitted, it explains too little of that"
        return "scored", f"{seen}, {sure:g} σ are asked"

    def _not_tried(self, name: str) -> str:
        kind = CATALOGUE[name]
        if name in self.search.meaningless:
            return "means nothing for this instrument or these recordings"
        if kind.widens:
            return f"a wider form of {kind.widens}, tried where that is found"
        return ELSEWHERE.get(kind.found_by, "not tried")


def _lost(best: Accepted, other: Ranked) -> str:
    """By how much a name lost against the one that was chosen."""
    first = best.ranking[0]
    why = f"explains {other.explained:.1%} where {first.name} explains {first.explained:.1%}"
    if other.name in [one.name for one in best.alternatives]:
        return f"{why}: not distinguished from it"
    return f"{why}; Δχ² {first.gain - other.gain:.3g}, on data that no fit has seen z {other.held_out_z:.1f}"
