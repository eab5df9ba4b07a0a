"""The search where nothing is exactly as declared: everything is free, and names are what has the evidence.

At a telescope the pupil, the scale, the band and the wavefront all differ a little from what a profile
states, and there is a little of every mild effect. All of it is fitted at once with its prior (`posterior`).
What else may be missing is proposed by linear tests at the optimum and fitted jointly with everything; what
has the best odds enters the model, until nothing has any. In the end an effect is named if the odds against
its absence, and frames that no fit has seen, are clearly for it; what is not sure enough stays as adjusted.
"""

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce

import numpy as np
import torch

from irlos_pipe.conventions.units import resolution_px
from irlos_pipe.diagnosis.acceptance import DECIDED, Accepted, Search, gap_between, preference
from irlos_pipe.diagnosis.checks.drift import MOVING, motion_ratio
from irlos_pipe.diagnosis.checks.pixels import bad_pixel_family
from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.forward import Task, families
from irlos_pipe.diagnosis.grade import AT_ITS_PLACE, copies_in_a_row, share_at_its_place
from irlos_pipe.diagnosis.null_model import FAR_OFF, Optimum, gaussian_sigma
from irlos_pipe.diagnosis.posterior import (
    Covariance,
    Laplace,
    Linear,
    Posterior,
    WavefrontLaw,
    fitted_as,
    with_visible_modes,
)
from irlos_pipe.diagnosis.records import Alternative, Ranked
from irlos_pipe.diagnosis.refit import Refit
from irlos_pipe.diagnosis.scores import Family, Score, close_copies, score_family, scored, whitened_shapes
from irlos_pipe.effects import Effect, FixedEffect, everyday, in_other_forms
from irlos_pipe.effects.effect_set import labels_of
from irlos_pipe.effects.pupil_places import PupilPlace
from irlos_pipe.estimate.score_test import LinearEstimate
from irlos_pipe.estimate.starts import on_other_sides
from irlos_pipe.numerics.parallel import ordered_map

SURE = 25.0  # ln odds from which an effect is named: those of false ones reached 14 in tuning runs
WORTH = 10.0  # ln odds from which an effect enters the model
PROMISING = 3.0  # ln odds by a linear test from which an effect is fitted
MOST_RIVALS = 2  # that are told besides a name
LOOKED_AT = 2  # effects fitted at once, those of the best odds
FIRST, AGAIN, JOINTLY = 16, 4, 8  # iterations of the first fit, after a change of laws, with an effect more
FOLLOWING, TURNED = 3, 6  # iterations from another side: of all else, and of everything
SIDES = 2  # that are followed to their end, those on which all else has made the most of it
WITHIN = 1.0  # of a prior's σ, in which an effect begins
FINER = 0.5  # by which the steps of a search for a place get smaller
LEAST = 0.02  # and the last of them, of the range or λ/D


@dataclass(frozen=True)
class EvidenceTask(Task):
    """A search with everything free, besides what the model has."""

    kind: str  # of the noise

    def beyond(self, search: Search, effects: Sequence[Effect]) -> Search:
        """Begin again from `effects` where a plain `search` left much."""
        drift = search.drift
        moving = [self._drifting(drift)] if drift and drift.significance > self.options.sure else []
        declared = [*effects, *moving]
        conditions = [view.conditions for view in self.fitter.views]
        fitter, few_colours = with_visible_modes(self.fitter.of(self.cube.training))
        law = WavefrontLaw.of(self.conditions.ncpa_law, self.fitter.views[0].psf.nolls[-1])
        covariance = Covariance.of(fitter.stack, fitter.views)

        def begun(near: Fitted | None) -> Laplace:
            known_effects = declared if near is None else near.continued()
            whole = [*known_effects, *everyday(conditions, known_effects)]
            posterior = Posterior(fitter, few_colours, whole, covariance, law)
            return posterior.minimised(posterior.start(near), FIRST, roughly=True)

        starts = ordered_map(begun, (None, search.final.fitted))
        laplace = self._settled(max(starts, key=lambda one: one.log_evidence))
        entered = {one.base: math.inf for one in laplace.fitted.effects}  # the odds with which they did
        most = len(entered) + self.options.most_names * len(self.moments.by_number)
        known: list[Score] = []
        while True:
            # Each time that the model gets better its errors get smaller, which shows sides apart.
            while (other := self._turned(laplace)).log_evidence > laplace.log_evidence + PROMISING:
                laplace = self._settled(other)
            found = self._proposed(laplace, known)
            best = self._best(laplace, found) if len(laplace.fitted.effects) <= most else None
            if best is None:
                break
            before, laplace = laplace, self._settled(best[0])
            odds = (laplace.log_evidence - before.log_evidence) / best[1]
            entered |= {one.base: odds for one in laplace.fitted.effects if one.base not in entered}
            if copies_in_a_row(laplace.fitted):  # which the detector makes: more would follow
                break
        wide = laplace
        for label in reversed(laplace.fitted.problem.effects.labels):  # before all is found, images blur more
            if label not in labels_of(declared):
                laplace = self._in_best_form(laplace, label, wider=False)
        if laplace is not wide:
            laplace = self._settled(laplace)
        if _misfit(self.cube.training, laplace) > FAR_OFF:
            laplace = self._nearest(laplace)
        laplace = laplace.posterior.minimised(laplace.x, JOINTLY, slopes=laplace.columns)
        return self._named(search, laplace, declared, entered, found)

    # -- fits ------------------------------------------------------------------------------------

    def _settled(self, laplace: Laplace) -> Laplace:
        """The fit with laws of wavefront and errors by evidence, which follow a change in several steps."""
        while True:
            law, covariance = laplace.with_best_law(), laplace.with_best_errors()
            posterior = replace(laplace.posterior, law=law, covariance=covariance)
            other = posterior.minimised(laplace.x, JOINTLY, roughly=True, slopes=laplace.columns)
            self.report(1)
            if other.log_evidence < laplace.log_evidence + PROMISING:
                return max(laplace, other, key=lambda one: one.log_evidence)
            laplace = other

    def _nearest(self, laplace: Laplace) -> Laplace:
        """The model of least squares, which is nearest to the images.

        Where much stays missing, what a fit leaves is no noise that would tell how pixels are correlated.
        """
        training = self.cube.training
        covariance = laplace.posterior.covariance.alone(_misfit(training, laplace) * _alike_px(laplace))
        posterior = replace(laplace.posterior, covariance=covariance)
        return posterior.minimised(laplace.x, FIRST, roughly=True)

    def _turned(self, laplace: Laplace) -> Laplace:
        """The best of a fit and others in which what has a distance and a direction begins elsewhere.

        To first order opposite sides are degenerate, and where it has come to rest the image has a kink. An
        error of the model, which grows by what a wrong side misses, would hide that: here there is none. All
        else follows first, or the kink would draw back what has just begun elsewhere.
        """
        fitted, posterior, sharp = laplace.fitted, laplace.posterior, laplace.posterior.sharp
        starts = on_other_sides(fitted.problem.effects, fitted.problem.layout.effect_values, fitted.x)

        def following(start: tuple[Effect, torch.Tensor, list[int]]) -> tuple[torch.Tensor, float]:
            _, x, columns = start
            return sharp.descended(x, FOLLOWING, roughly=True, held=columns, slopes=laplace.columns)

        promising = sorted(ordered_map(following, starts), key=lambda one: one[1])[:SIDES]
        sides = [laplace.x, *(x for x, _ in promising)]
        ends = ordered_map(lambda x: sharp.descended(x, TURNED, roughly=True), sides)
        self.report(len(ends))
        return posterior.minimised(min(ends, key=lambda one: one[1])[0], AGAIN, roughly=True)

    def _best(self, laplace: Laplace, found: Sequence[Score]) -> tuple[Laplace, float] | None:
        """The fit with the effect of the best odds, and their inflation; None if none is worth it."""
        likely = [one for one in found if one.log_odds > PROMISING][:LOOKED_AT]
        tried = [
            ((other.log_evidence - laplace.log_evidence) / inflation, inflation, other)
            for score, other in zip(likely, ordered_map(partial(self._joined, laplace), likely), strict=True)
            if other is not None
            for inflation in [max(1.0, score.inflation)]
        ]
        self.report(1)
        if not tried:
            return None
        odds, inflation, best = max(tried, key=lambda one: one[0])
        if odds < WORTH:
            return None
        known = {*laplace.fitted.problem.effects.labels}
        label = next(one for one in best.fitted.problem.effects.labels if one not in known)
        return self._in_best_form(best, label, wider=True), inflation

    def _joined(self, laplace: Laplace, score: Score) -> Laplace | None:
        """The fit with one effect more, from where all others make room for it; None if it fails."""
        start = score.whole(WITHIN)
        null = torch.tensor(score.candidate.null_values, dtype=torch.float64)
        sizes = start.values[score.candidate.free] - null.numpy()
        shape = whitened_shapes(laplace, [score.candidate])[0] @ torch.as_tensor(sizes)

        def begun(fitted: Fitted) -> tuple[Posterior, torch.Tensor]:
            posterior = replace(laplace.posterior, effects=[*fitted.continued(), start])
            return posterior, posterior.start(fitted)

        starts = map(begun, (laplace.fitted, laplace.fitted.moved(laplace.making_room(shape))))
        try:
            posterior, x = min(starts, key=lambda one: one[0].left(one[1])[1])
            return posterior.minimised(x, JOINTLY, roughly=True)
        except (ValueError, torch.linalg.LinAlgError):
            return None

    def _in_best_form(self, laplace: Laplace, label: str, *, wider: bool) -> Laplace:
        """The fit with an effect, or with a wider or narrower form that has better odds.

        An error of the model would hide that a form is too narrow: for wider ones there is none.
        """
        fitted, others = laplace.fitted, laplace.fitted.continued_by_label()
        found = others.pop(label)
        forms = in_other_forms(found.name, self.conditions, fitted.values_of(label), wider=wider)
        if not forms:
            return laplace
        judge = laplace.posterior.sharp if wider else laplace.posterior
        best = judged = judge.minimised(laplace.x, AGAIN, roughly=True, slopes=laplace.columns)
        for form in (side for one in forms for side in _sides(one, len(found.base.parameters))):
            posterior = replace(judge, effects=[*others.values(), form.only_in(found.acts_in)])
            other = posterior.minimised(posterior.start(fitted), AGAIN, roughly=True)
            if other.log_evidence > best.log_evidence + (PROMISING if wider else -PROMISING):
                best = other
        if best is not judged:
            posterior = replace(laplace.posterior, effects=best.fitted.continued())
            return posterior.minimised(best.x, JOINTLY, roughly=True)
        return laplace

    # -- proposals -------------------------------------------------------------------------------

    def _proposed(self, laplace: Laplace, known: list[Score]) -> list[Score]:
        """Scores of all families that the model lacks, those of the best odds first.

        Places are refined: of second images also near the core, and in the pupil, where modes imitate most of
        what is there, also from where they were found before: `known`, which gets those found now.
        """
        missing, _ = families(self.moments, laplace.fitted.effects)

        def scored_best(family: Family) -> Score:
            score = score_family(laplace, family)
            if family.effect.copies_star:
                near = close_copies(laplace, family.effect)
                others = scored(laplace, score.trials, family.placements, near)
                others = sorted(others, key=lambda one: one.log_odds)[-1:]
            elif isinstance(family.effect.base, PupilPlace):
                others = [*score.elsewhere, *[one for one in known if one.name == score.name][-1:]]
            else:
                return score
            return max((_refined(laplace, one) for one in (score, *others)), key=lambda one: one.log_odds)

        found = ordered_map(scored_best, [*missing, *bad_pixel_family(laplace)])
        known += [one for one in found if isinstance(one.candidate.base, PupilPlace)]
        self.report(1)
        return sorted(found, key=lambda one: -one.log_odds)

    # -- names -----------------------------------------------------------------------------------

    def _named(
        self,
        search: Search,
        laplace: Laplace,
        declared: Sequence[Effect],
        entered: dict[Effect, float],
        found: list[Score],
    ) -> Search:
        """The search with its names: what has the odds, explains its own, and no held-out data object to."""
        final = _Final(self, laplace, declared)
        beyond = final.beyond
        named = [one for label in beyond if (one := self._judged(final, label, entered, found)) is not None]
        named = sorted(named, key=lambda one: (one.ordinary, -one.refit.gain))
        adjusted = sorted(set(beyond) - {one.label for one in named})
        nearest = None if named else next(iter(search.accepted), None)
        return Search(
            search.null,
            final.optimum,
            search.drift,
            named,
            found,
            search.meaningless,
            adjusted,
            nearest,
            tolerant=True,
        )

    def _judged(
        self, final: "_Final", label: str, entered: dict[Effect, float], found: Sequence[Score]
    ) -> Accepted | None:
        """The name for an effect of the final model, or None."""
        odds = entered.get(final.all_modes.effect(label).base, math.inf)
        if not min(final.log_odds(label), odds) > SURE:
            return None
        refit = final.refit(label)
        lit = _is_lit(final.laplace, refit.base, refit.values)
        if refit.significance < self.options.sure or refit.implausible or not lit:
            return None
        # Copies of the star lie near its core, where the model's error counts in their odds.
        share = 1.0 if refit.base.copies_star else share_at_its_place(refit, final.optimum)
        if share < AT_ITS_PLACE[self.kind]:
            return None
        stack, without = self.cube.held_out, refit.origin.fitted
        z = preference(stack, refit.fitted, without)
        if z < -DECIDED:  # of images that hardly differ, as by modes beyond the basis, it is a normal deviate
            return None
        rivals = final.rivals(refit, found)
        alternatives = [
            Alternative(one.name, f"it explains as much (|cos| {cosine:.3f})", refit.base.look_alike, cosine)
            for one, cosine in rivals
        ]
        ranking = [Ranked(refit.name, refit.gain, 1.0, refit.significance, z)]
        gap = gap_between(stack, without, refit.fitted)
        return Accepted(refit, z, gap, alternatives, ranking, [one for one, _ in rivals])


class _Final:
    """The last fit, the modes beyond the closed basis known, without the effects that are dispensable."""

    def __init__(self, task: EvidenceTask, laplace: Laplace, declared: Sequence[Effect]):
        self.task, self.laplace = task, laplace
        self._shapes: dict[int, torch.Tensor] = {}
        self.all_modes = laplace.fitted
        self.linear = self._without_dispensable({*labels_of(declared)})
        present = (one for one in self.all_modes.problem.effects.labels if one not in self.linear.gone)
        self.beyond = [label for label in present if label not in labels_of(declared)]
        closed = len(task.fitter.views[0].psf.nolls)
        nolls = self.all_modes.problem.layout.nolls
        beyond = dict(zip(nolls[closed:], self.linear.x[closed : len(nolls)].tolist(), strict=True))
        views = [view.with_known(beyond) for view in task.fitter.views] if beyond else ()
        self.fitter = task.fitter.of(task.cube.training, views)
        self.rows = [i for i in range(len(self.linear.x)) if not closed <= i < len(nolls)]
        self.fitted = self._reduced(self.linear)

    def _without_dispensable(self, declared: Container[str]) -> Linear:
        """The model without effects whose odds are against them, the least likely first.

        Of what blurs, frames that show no motion leave what a detector does, and the other way round.
        """
        linear = self.laplace.linear()
        labels = [one for one in self.all_modes.problem.effects.labels if one not in declared]
        training, right = self.task.cube.training, ""
        if training.held_out == "frames":
            right = "motion" if motion_ratio(training, self.all_modes) > MOVING else "detector"

        def worth(label: str) -> tuple[bool, float]:
            blurs = self.all_modes.effect(label).blurs
            return not (blurs and right and blurs != right), linear.log_odds(label)

        while labels:
            least = min(labels, key=worth)
            if linear.log_odds(least) > (0.0 if worth(least)[0] else WORTH):
                if worth(least)[0]:
                    break
                labels.remove(least)
                continue
            linear = linear.without(least)
            labels.remove(least)
        return linear

    @cached_property
    def optimum(self) -> Optimum:
        """With the errors of flat and model in the variances that the fit has found."""
        stack, laplace = self.task.cube.training, self.laplace
        misfit, flat = max(1.0, _misfit(stack, laplace)), laplace.posterior.covariance.flat_rms
        return Optimum(stack.with_errors(flat, misfit, _alike_px(laplace)), self.fitted)

    def _reduced(self, linear: Linear) -> Fitted:
        """The linear model in the closed basis."""
        laplace, whole = self.laplace, self.all_modes
        gone = {column for label in linear.gone for column in whole.columns_of(label)}
        rows = [row for row in self.rows if row not in gone]
        effects = [one for label, one in whole.continued_by_label().items() if label not in linear.gone]
        problem = self.fitter.problem(effects, self.fitter.views)
        values = linear.x[None, rows].clamp(problem.lower, problem.upper)
        covariance = linear.covariance[rows][:, rows][None]
        solution = replace(whole.solution, values=values, covariance=covariance)
        image = laplace.image + laplace.columns.mT @ linear.move
        return fitted_as(
            problem, solution, self.task.cube.training, self.fitter.views, image, laplace.columns[rows]
        )

    def log_odds(self, label: str) -> float:
        """ln odds of an effect against its absence."""
        if self.linear.nulls_of(label):
            return self.linear.log_odds(label)
        return self.laplace.log_evidence - self._without(label).log_evidence

    def _without(self, label: str) -> Laplace:
        """The fit without an effect to whose absence no model is linear, as that of an AO residual."""
        fitted = self.laplace.fitted
        others = fitted.continued_by_label()
        del others[label]
        posterior = replace(self.laplace.posterior, effects=[*others.values()])
        return posterior.minimised(posterior.start(fitted), JOINTLY, roughly=True)

    def refit(self, label: str) -> Refit:
        """The model against that without an effect."""
        if not self.linear.nulls_of(label):
            others = self.fitted.continued_by_label()
            base = others.pop(label).base
            origin = Optimum(self.optimum.stack, self.fitter.explored([*others.values()], self.fitted))
            return Refit(score_family(origin, Family((base,))), origin, self.fitted, label)
        optimum = Optimum(self.optimum.stack, self._reduced(self.linear.without(label)))
        effect = self.fitted.effect(label)
        score = self._scored(optimum, effect, self.fitted.values_of(label))
        frames = math.inf if self.optimum.stack.photon_limited else self.optimum.stack.independent
        rise, count = self.linear.rise_without(label), len(effect.parameters)
        return Refit(score, optimum, self.fitted, label, gaussian_sigma(rise, count, frames))

    def rivals(self, refit: Refit, found: Sequence[Score]) -> list[tuple[Refit, float]]:
        """Fits of effects that would explain as much in the place of one, with their |cos|.

        They are wider forms of it, those `found` that the model never had, and those that were dispensable
        beside it.
        """
        label, laplace = refit.label, self.laplace
        if not self.linear.nulls_of(label):
            return []
        rise, null = self.linear.rise_without(label), laplace.null_of(self.linear.without(label))
        effects = self.all_modes.continued_by_label()
        rivals: list[tuple[Effect, Score, float]] = []
        for score in found:
            if score.candidate.base.needs_search or score.name == refit.name:
                continue
            linear = LinearEstimate.of(null, score.candidate, self._shapes_of(score.candidate))
            if linear.usable.any():
                rivals.append((score.start(), score, rise - linear.gain))
        for gone in self.linear.gone:
            others = (one for one in self.linear.gone if one != gone)
            with_it = reduce(Linear.without, others, laplace.linear())
            score = self._scored(refit.origin, effects[gone], effects[gone].base.null_values)
            rivals.append((effects[gone], score, with_it.rise_without(label)))
        for form in refit.wider_forms(self.task.conditions):
            rivals.append((form, self._scored(refit.origin, form, form.values), 0.0))
        fits = []
        for effect, score, left in sorted(rivals, key=lambda one: one[2])[:MOST_RIVALS]:
            if left < 2 * WORTH:
                origin = refit.origin.fitted
                fitted = self.fitter.explored([*origin.continued(), effect], origin)
                cosine = math.sqrt(max(1 - max(left, 0.0) / rise, 0.0))
                fits.append((Refit(score, refit.origin, fitted), cosine))
        return fits

    def _shapes_of(self, candidate: Effect) -> torch.Tensor:
        """Its whitened derivatives, which every name is compared with."""
        if id(candidate) not in self._shapes:
            self._shapes[id(candidate)] = whitened_shapes(self.laplace, [candidate])[0]
        return self._shapes[id(candidate)]

    @staticmethod
    def _scored(origin: Optimum, effect: Effect, values: Sequence[float] | np.ndarray) -> Score:
        """The score of an effect at its place, without it."""
        sizes = [one.name for one in effect.parameters if one.null is not None]
        candidate = FixedEffect(effect.base, values, sizes).only_in(effect.acts_in)
        return scored(origin, 1, (effect.acts_in,), [candidate])[0]


def _sides(form: FixedEffect, known: int) -> list[FixedEffect]:
    """A form of an effect, begun on either side in what it has besides the `known` parameters.

    An image out of focus on one side of the focus is far from that on the other.
    """
    found = []
    for index, one in enumerate(form.base.parameters):
        for side in (-1, 1) if index >= known and math.isfinite(one.prior_sigma) else ():
            values = np.array(form.values, float)
            values[index] += side * one.prior_sigma / 2
            found.append(FixedEffect(form.base, values, [p.name for p in form.parameters]))
    return found or [form]


def _alike_px(laplace: Laplace) -> float:
    """Number of pixels that what a model misses changes alike: those of an Airy disc."""
    settings = laplace.settings
    across_px = resolution_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)
    return max(1.0, np.pi / 4 * across_px**2)


def _misfit(stack: Stacks, laplace: Laplace) -> float:
    """χ²/ν with the error of the flat in the variances, and none of the model."""
    root = stack.with_errors(laplace.posterior.covariance.flat_rms).root
    white = (stack.mean_e - laplace.image) * root
    return float(white @ white) / laplace.fitted.problem.freedom


def _is_lit(laplace: Laplace, effect: Effect, values: np.ndarray) -> bool:
    """Whether light passes the place of an effect in the pupil."""
    if not isinstance(effect.base, PupilPlace):
        return True
    geometry, away_m = laplace.settings.geometry, float(np.hypot(*values[1:3]))
    return geometry.obscuration_m <= 2 * away_m <= geometry.diameter_m


def _refined(laplace: Laplace, score: Score) -> Score:
    """The candidate of the best odds near one: a search in smaller and smaller steps."""
    base, free = score.candidate.base, [one.name for one in score.candidate.parameters]
    places = [i for i, one in enumerate(base.parameters) if one.null is None]  # and widths
    lower, upper = (np.array([getattr(base.parameters[i], n) for i in places]) for n in ("lower", "upper"))
    span = np.full(len(places), laplace.settings.resolution_mas) if base.copies_star else upper - lower
    best = scored(laplace, score.trials, (score.candidate.acts_in,), [score.candidate])[0]
    at = best.candidate.all_values(best.candidate.null_values).numpy()
    step = 0.1
    while step > LEAST:
        moves = step * span * np.concatenate([np.eye(len(places)), -np.eye(len(places))])
        tried = []
        for move in moves:
            values = at.copy()
            values[places] = np.clip(at[places] + move, lower, upper)
            if _is_lit(laplace, base, values):
                tried.append(FixedEffect(base, values, free).only_in(score.candidate.acts_in))
        found = scored(laplace, score.trials, (score.candidate.acts_in,), tried) if tried else []
        better = max([best, *found], key=lambda one: one.log_odds)
        if better is best:
            step *= FINER
        else:
            best, at = better, better.candidate.all_values(better.candidate.null_values).numpy()
    return replace(best, trials=score.trials, log_odds=best.log_odds - math.log(score.trials))
