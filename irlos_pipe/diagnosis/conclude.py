"""From what a search found to the verdict, and to the search log of effects that are not named."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.diagnosis.acceptance import Accepted, HeldOutEvaluation, Search, gap_between
from irlos_pipe.diagnosis.checks import OUTSTANDING, fine_structure, flat_rms, motion_ratio, smallest_excess
from irlos_pipe.diagnosis.cube import Cube
from irlos_pipe.diagnosis.effect_sizes import Covariances, detectable, within_reach
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.grade import judged, share_at_its_place
from irlos_pipe.diagnosis.null_model import Optimum, gaussian_sigma
from irlos_pipe.diagnosis.records import Gap, NoiseVerdict, Options, Ranked, Tried
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
    rest_of,
)
from irlos_pipe.diagnosis.view import Screened
from irlos_pipe.effects import CATALOGUE, Effect, FixedEffect
from irlos_pipe.effects.detector import BadPixels
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.public_values import public_sigma
from irlos_pipe.estimate.image_fit import effects_in_modes_nm

OFF = 0.1  # part of the star's signal in a pixel, below which the model may be to blame
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
    rows = zip(search.accepted, judgement.shares, strict=True)
    steps = [*_drift_steps(cube, search, options), *(_step(one, covariances, share) for one, share in rows)]
    nearest = None
    if (one := search.nearest) is not None:
        nearest = _step(one, covariances, share_at_its_place(one, search.final))
    final, after = (search.null, before) if why else (plain, after)
    left_fine = fine_structure(search.null) if why else fine
    flat = 0.0
    if not why and fine.significance >= options.sure:
        part, image_e = final.stack.parts[0], final.fitted.image_e[final.fitted.problem.pixels[0]]
        flat = flat_rms(part, part.mean_e - image_e, final.settings)
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
        # before what is to be expected of any instrument
        usual = [step.effect.base.ordinary(step.effect.values) for step in known]
        place = usual.index(True) if any(usual) else len(known)
        known, gap = [*known[:place], pixels, *known[place:]], replace(gap, before=pixels.gap.before)
    left = judgement.left or fine.significance > options.sure
    modes_nm, final_nm = total_modes_nm(search.null.fitted), total_modes_nm(final.fitted)
    return Diagnosis(
        verdict=UNKNOWN if why else EFFECT if known else NONE,
        grade=judgement.grade if why or not known else PARTIAL if left else COMPLETE,
        steps=known,
        nearest=(steps[0] if steps else nearest) if why else None,
        unexplained=bool(why) or left,
        why_unknown=why,
        adjusted=_adjusted(search, covariances) if not why else [],
        tried=tried(search, options, hidden, named=not why),
        rest=rest_of(after, gap.floor, left_fine, options.sure, final.settings, flat),
        gap=gap,
        mdb=_detectable(search, options, testable),
        untestable=[*(s.name for s in hidden), *search.meaningless],
        advice={s.name: advice for s in hidden if (advice := seconds.showing(s)) is not None},
        noise=noise,
        fine=fine,
        chi2_nu=(search.null.excess.chi2_nu, plain.excess.chi2_nu),
        excess_sigma=(search.null.excess.significance, plain.excess.significance),
        motion_ratio=motion_ratio(cube.training, search.final.fitted),
        drift_significance=search.drift.significance if search.drift else float("nan"),
        frames=cube.frames,
        held_out=cube.training.held_out,
        nolls=final.fitted.problem.layout.nolls,
        modes_nm=(np.pad(modes_nm, (0, len(final_nm) - len(modes_nm))), final_nm),
        modes_sigma_nm=(Covariances(final.stack, final.fitted) if why else covariances).modes_sigma_nm(),
        pictures=_pictures((before, after), search.null, final),
    )


def total_modes_nm(fitted: Fitted) -> np.ndarray:
    """Coefficients of the whole static wavefront of the first recording, effects in the pupil included."""
    part, x = fitted.recordings[0]
    added = effects_in_modes_nm(part.model.effects, x[0, part.layout.effect_values], part.layout.nolls)[0]
    return x[0, part.layout.modes].numpy() + added.numpy()


def _detectable(search: Search, options: Options, testable: Sequence[Score]) -> dict[str, dict]:
    """Public sizes that would surely have been seen, by effect; drift and pixels have no score.

    Wider forms of an effect are degenerate with it at best.
    """
    limits: dict[str, dict] = {}
    for score in testable:
        limits[score.name] = {}
        for one in (*score.besides, score):
            limits[score.name] |= detectable(one)
    wider = {name: kind.widens for name, kind in CATALOGUE.items() if kind.widens in limits}
    limits |= {name: limits[narrower] for name, narrower in wider.items()}
    if search.drift and search.drift.significance < options.sure:
        drift = search.drift.effect().base
        limits[drift.name] = drift.describe(search.drift.detectable_nm(options.sure))
    if not any(one.effect.found_by == "pixels" for one in search.accepted):
        limits |= smallest_excess(search.final)
    return limits


def _with_separation(step: Step, search: Search, seconds: SecondRecordings) -> Step:
    """`step` with the second recordings that distinguish its alternatives from it best."""
    advised = [
        pair
        for one in search.accepted
        if one.label == step.label
        for pair in seconds.separating(one, one.rivals)
    ]
    alternatives = [
        replace(other, second_recording=recording, likeness_then=cosine)
        for other, (recording, cosine) in zip(step.alternatives, advised, strict=True)
    ]
    return replace(step, alternatives=alternatives)


def _adjusted(search: Search, covariances: Covariances) -> list[Adjusted]:
    """Effects that make the final model fit better and are not named, as it has them."""
    fitted, found = search.final.fitted, []
    for label in fitted.problem.effects.labels:
        if label in search.adjusted:
            base, values, full = fitted.effect(label).base, fitted.values_of(label), covariances.of(label)
            rows = zip(base.parameters, values, np.diag(full) ** 0.5, strict=True)
            apart = [abs(value - p.null) / s for p, value, s in rows if p.null is not None and s > 0]
            sizes = _sizes(base, values, full)
            found.append(Adjusted(**sizes, label=label, significance=max(apart, default=0.0)))
    return found


# -- names -------------------------------------------------------------------------------------


def _step(accepted: Accepted, covariances: Covariances, share: float) -> Step:
    """A name as the model has it whose covariances are given."""
    label = accepted.label
    return Step(
        **_sizes(accepted.base, covariances.fitted.values_of(label), covariances.of(label)),
        share=share,
        significance=accepted.significance,
        explained=accepted.explained,
        preference=accepted.preference,
        gap=accepted.gap,
        alternatives=accepted.alternatives,
        ranking=accepted.ranking,
        label=label,
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


def screened_step(screened: Sequence[Screened], optimum: Optimum, frames: int, gap: Gap) -> Step | None:
    """The step for those of the pixels whose mean is not what the model predicts; None if all agree.

    The first recording of the `optimum` is that of the pixels, whose means are those of so many `frames`;
    `gap` is that without them.
    """
    window, stack = optimum.fitted.problem.window, optimum.stack.parts[0]
    star_e = optimum.fitted.image_e[optimum.fitted.problem.pixels[0]]
    sigma_e = stack.frames.noise.mean_variance_e2(star_e, frames).sqrt().reshape(window)
    off = [(one, one.mean_e - float(star_e.reshape(window)[one.row, one.column])) for one in screened]
    pulls = {one: miss / float(sigma_e[one.row, one.column]) for one, miss in off}
    bad = [
        (one, miss)
        for one, miss in off
        if pulls[one] ** 2 > OUTSTANDING and abs(miss) > OFF * abs(one.mean_e - miss)
    ]
    if not bad:
        return None
    effect = BadPixels([(one.row, one.column) for one, _ in bad])
    significance = gaussian_sigma(sum(pulls[one] ** 2 for one, _ in bad), len(bad), np.inf, len(star_e))
    nothing = np.zeros(len(bad))
    sigma = {"pixels": [[0.0, 0.0] for _ in bad]}
    # the gap of the window with the pixels in it
    light_e, missing_e = float(star_e.sum()), sum(abs(miss) for _, miss in bad)
    whole_e = light_e + sum(max(one.mean_e, 0.0) for one, _ in bad)
    found = Gap((gap.before * light_e + missing_e) / whole_e, gap.before, gap.floor)
    return Step(
        FixedEffect(effect, nothing), effect.describe(nothing), sigma, significance, np.nan, np.nan, found
    )


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
    grid = models[1].psf.grids.pupil
    before, after = (judge.mean_e[first].reshape(shape).numpy() for judge in judges)
    return Pictures(
        measured_e=stack.mean_e.reshape(shape).numpy(),
        sigma_e=stack.variance_e2.sqrt().reshape(shape).numpy(),
        before_e=before,
        after_e=after,
        leading=leading.reshape(shape).numpy(),
        added_opd_nm=np.where(grid.amplitude > HALF_CLEAR * grid.light, opds[1] - opds[0], np.nan),
        added_amplitude=_amplitude(models[1], values[1]) - _amplitude(models[0], values[0]),
    )


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
    found = []
    for name in CATALOGUE:
        score = next((one for one in search.scores if one.name == name), None)
        fate = _fate(search, options, name, named) or (
            _unnoticed(search, name)
            if score is None
            else _scored(score, options.sure, absorbed=name in {one.name for one in hidden})
        )
        significance = float("nan") if score is None else score.significance
        found.append(Tried(name, fate[0], significance, fate[1]))
    return found


def _fate(search: Search, options: Options, name: str, named: bool) -> tuple[Outcome, str] | None:
    """What became of an effect that a model has or had, and why."""
    drift, names = search.drift, [one.name for one in search.accepted]
    if drift and drift.significance > options.sure:
        names.append(drift.effect().name)
    if name in names:
        return ("named", "") if named else ("nearest", "fitted, and leaves too much to be named")
    if any(effect.name == name for effect in search.null.fitted.effects):
        return "modelled", "in the model from the start"
    if any(effect.name == name for effect in search.final.fitted.effects):
        return "adjusted", "the model fits better with it, but it is not sure enough to be named"
    for one in search.accepted:
        for other in one.ranking[1:]:
            if other.name == name:
                return "fitted", _lost(one, other)
    return None


def _scored(score: Score, sure: float, *, absorbed: bool) -> tuple[Outcome, str]:
    if absorbed:
        part = score.observability
        return "absorbed", f"the free parameters imitate all but {part:.1%} of what it does to the image"
    seen = f"{max(score.significance, 0.0):.1f} σ in what is left"
    if score.significance > sure:
        return "scored", f"{seen}; fitted, it explains too little of that"
    return "scored", f"{seen}, {sure:g} σ are asked"


def _unnoticed(search: Search, name: str) -> tuple[Outcome, str]:
    kind = CATALOGUE[name]
    if name in search.meaningless:
        return "not tried", "means nothing for this instrument or these recordings"
    if search.tolerant and (kind.fact or kind.mild):
        return "fitted", "free in the fit of everything, where the odds are against it"
    if kind.widens:
        return "not tried", f"a wider form of {kind.widens}, tried where that is found"
    return "not tried", ELSEWHERE.get(kind.found_by, "not tried")


def _lost(best: Accepted, other: Ranked) -> str:
    """By how much a name lost against the one that was chosen."""
    first = best.ranking[0]
    why = f"explains {other.explained:.1%} where {first.name} explains {first.explained:.1%}"
    if other.name in [one.name for one in best.alternatives]:
        return f"{why}: not distinguished from it"
    return f"{why}; Δχ² {first.gain - other.gain:.3g}, on data that no fit has seen z {other.held_out_z:.1f}"
