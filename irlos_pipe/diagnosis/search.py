"""The search where nothing is exactly as declared: everything is free, and names are what has the evidence.

At a telescope the pupil, the scale, the band and the wavefront all differ a little from what a profile
states, and there is a little of every mild effect. All of it is fitted at once with its prior (`posterior`).
What else may be missing is proposed by linear tests at the optimum and fitted jointly with everything; what
has the best odds enters the model, until nothing has any. In the end an effect is named if the odds against
its absence, and frames that no fit has seen, are clearly for it; what is not sure enough stays as adjusted.
"""

import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.diagnosis.acceptance import Search
from irlos_pipe.diagnosis.checks import Drift, bad_pixel_family, measure_drift
from irlos_pipe.diagnosis.cube import Cube
from irlos_pipe.diagnosis.final import JOINTLY, WORTH, Final
from irlos_pipe.diagnosis.fitting import Fitted, Fitter
from irlos_pipe.diagnosis.grade import copies_in_a_row
from irlos_pipe.diagnosis.null_model import FAR_OFF, Optimum
from irlos_pipe.diagnosis.posterior import (
    Covariance,
    Laplace,
    Posterior,
    WavefrontLaw,
    with_visible_modes,
)
from irlos_pipe.diagnosis.records import Options
from irlos_pipe.diagnosis.scores import (
    Family,
    Score,
    close_copies,
    families,
    score_family,
    scored,
    scores,
    whitened_shapes,
)
from irlos_pipe.diagnosis.view import Moments
from irlos_pipe.effects import CATALOGUE, Conditions, Effect, FixedEffect, everyday, in_other_forms
from irlos_pipe.effects.effect_set import labels_of
from irlos_pipe.effects.pupil_places import PupilPlace
from irlos_pipe.estimate.starts import on_other_sides
from irlos_pipe.numerics.parallel import ordered_map

PER_PARAMETER = 8.0  # fall of χ² that a parameter has to earn
PROMISING = 3.0  # ln odds by a linear test from which an effect is fitted
LOOKED_AT = 2  # effects fitted at once, those of the best odds
FIRST, AGAIN = 16, 4  # iterations of the first fit, after a change of laws
TURNED = 6  # iterations from another side
SIDES = 2  # that are followed to their end, those on which all else has made the most of it
WITHIN = 1.0  # of a prior's σ, in which an effect begins
FINER = 0.5  # by which the steps of a search for a place get smaller
LEAST = 0.02  # and the last of them, of the range or λ/D

Report = Callable[[int], None]


@dataclass(frozen=True)
class Task:
    """A cube with the means to fit it."""

    cube: Cube
    fitter: Fitter
    moments: Moments
    options: Options
    report: Report
    kind: str  # of the noise

    @property
    def conditions(self) -> Conditions:
        """Those of the first recording, for which effects are stated."""
        return self.fitter.views[0].conditions

    def searched(self, effects: Sequence[Effect]) -> Search:
        """Find what a model with some `effects` is missing."""
        return self.searched_from(self._null(effects), effects)

    def searched_from(self, fitted: Fitted, effects: Sequence[Effect]) -> Search:
        """The same from a fit of the model as it is: nothing, where no test there shows anything."""
        null = Optimum(self.cube.training, fitted)
        drift, current = self._with_drift(null)
        found, meaningless = self._scores(current)
        search = Search(null, current, drift, [], found, meaningless)
        tests = [current.excess.significance, *(one.significance for one in found)]
        if max(tests) < self.options.sure:
            return search
        alone, further = self._alone(current, found), None
        if alone.excess.significance < self.options.sure:
            further, _ = self._scores(alone)
            if any(one.significance > self.options.sure for one in further):
                further = None
        return self._beyond(search, effects, alone.fitted, further)

    # -- the model as it is ----------------------------------------------------------------------

    def _null(self, effects: Sequence[Effect]) -> Fitted:
        """The fit without anything new, of it, its twins and one begun elsewhere the most plausible.

        A changing wavefront has many false minima: the fit with it starts from that of a constant one.
        """
        constant = [effect for effect in effects if effect.plane != "time"]
        near = self._null(constant) if len(constant) < len(effects) else None
        found = [self.fitter.fit(effects, near)]
        found.append(self.fitter.twin(found[0]))
        if found[1].chi2 < found[0].chi2:  # a deeper minimum, which has a twin of its own
            found.append(self.fitter.twin(found[1]))
        if known_nm := self.options.begin_near_nm:
            found.append(self.fitter.fit(effects, found[0].with_wavefront(known_nm)))
        self.report(2)
        return self.fitter.most_plausible(found)

    def _with_drift(self, null: Optimum) -> tuple[Drift | None, Optimum]:
        """The drift of the frames, and the model with it if it is significant."""
        known = any(effect.found_by == "frames" for effect in null.fitted.effects)
        if known or self.cube.training.held_out == "pixels":
            return None, null
        drift = measure_drift(self.cube.training, null.fitted, self.options.sure)
        if drift.significance < self.options.sure:
            return drift, null
        fitted = self.fitter.fit([*null.fitted.continued(), self._drifting(drift)], null.fitted)
        return drift, Optimum(self.cube.training, fitted)

    def _drifting(self, drift: Drift) -> FixedEffect:
        """The drift as an effect, of several moments in the one in which it was seen."""
        moment = self.fitter.views[drift.recording].moment
        return drift.effect().only_in(frozenset({moment}) if self.moments.several else None)

    def _scores(self, current: Optimum) -> tuple[list[Score], list[str]]:
        """Scores of all families that the model lacks; and what means nothing here."""
        present = current.fitted.effects
        missing, meaningless = families(self.moments, present)
        if self.cube.training.held_out == "pixels":
            meaningless += [name for name, kind in CATALOGUE.items() if kind.found_by == "frames"]
        return scores(current, [*missing, *bad_pixel_family(current)]), meaningless

    def _alone(self, current: Optimum, found: Sequence[Score]) -> Optimum:
        """The fit with the one effect that explains most, all else as declared.

        It leads to where no fit of everything may come: what modes and facts take up together is far from
        what a single effect does. The two that promise most are fitted, the second where the first leaves
        something. A fact of which the model of everything has a rival instead comes after that, unless the
        rival's values are implausible.
        """

        def price(one: Fitted) -> float:
            return one.chi2 + PER_PARAMETER * len(one.effect_values)

        promising = [score for score in found if score.testable and score.gain > 0]
        usual = {one.name for one in self._with_everyday([])}
        known = {*current.fitted.problem.effects.labels}
        better: list[tuple[bool, float, Optimum]] = []
        for score in sorted(promising, key=lambda one: -one.gain / one.inflation)[:LOOKED_AT]:
            fitted = self.fitter.explored([*current.fitted.continued(), score.whole()], current.fitted)
            (label,) = {*fitted.problem.effects.labels} - known
            base = fitted.effect(label).base
            if price(fitted) < price(current.fitted) and not base.unusual(fitted.values_of(label)):
                one, rivalled = Optimum(self.cube.training, fitted), base.fact and base.name not in usual
                better.append((rivalled, price(fitted), one))
                if one.excess.significance < self.options.sure and not rivalled:
                    break
        self.report(1)
        return min(better, key=lambda one: one[:2])[2] if better else current

    # -- everything at once ----------------------------------------------------------------------

    def _with_everyday(self, effects: Sequence[Effect]) -> list[Effect]:
        return [*effects, *everyday([view.conditions for view in self.fitter.views], effects)]

    def _beyond(
        self, search: Search, effects: Sequence[Effect], alone: Fitted, further: list[Score] | None
    ) -> Search:
        """Begin again with everything free, from `effects` and from what explains most `alone`.

        Where this leaves nothing, the scores of all `further` effects are given: there everything is free for
        the sake of the errors, and nothing more is looked for.
        """
        drift = search.drift
        moving = [self._drifting(drift)] if drift and drift.significance > self.options.sure else []
        declared = [*effects, *moving]
        fitter, few_colours = with_visible_modes(self.fitter.of(self.cube.training))
        law = WavefrontLaw.of(self.conditions.ncpa_law, self.fitter.views[0].psf.nolls[-1])
        covariance = Covariance.of(fitter.stack, fitter.views)

        def begun(near: Fitted | None) -> Laplace:
            whole = self._with_everyday(declared if near is None else near.continued())
            posterior = Posterior(fitter, few_colours, whole, covariance, law)
            x, slopes = posterior.start(near), None
            if further is not None:  # larger errors than those of a fit that leaves nothing would lose it
                start = Laplace(posterior, x, coarse=True)
                posterior, slopes = replace(posterior, covariance=start.with_best_errors()), start.columns
            return posterior.minimised(x, FIRST, roughly=True, slopes=slopes)

        starts = ordered_map(begun, [None, alone] if further is None else [alone])
        laplace = max(starts, key=lambda one: one.log_evidence)
        usual = labels_of(self._with_everyday(declared))
        wide = self._in_best_forms(laplace, usual, wider=True)
        laplace = self._settled(laplace) if wide is laplace else wide
        # The odds with which they entered; what is free for the sake of errors has none.
        known = {one.name for one in (laplace.fitted if further is None else alone).effects}
        entered = {one.base: math.inf if one.name in known else 0.0 for one in laplace.fitted.effects}
        if further is None:
            laplace, further = self._extended(laplace, entered)
        if laplace.misfit > FAR_OFF:
            laplace = self._in_best_forms(self._nearest(laplace), labels_of(declared), wider=True)
        # Before all is found, images blur more.
        laplace = self._in_best_forms(laplace, labels_of(declared), wider=False)
        laplace = laplace.posterior.minimised(laplace.x, JOINTLY, slopes=laplace.columns)
        final = Final(self.cube, self.fitter, laplace, labels_of(declared), self.options.sure, self.kind)
        return final.named(search, entered, further)

    def _extended(self, laplace: Laplace, entered: dict[Effect, float]) -> tuple[Laplace, list[Score]]:
        """The fit with all effects that are worth it, their odds added to `entered`; and the last scores."""
        most = len(entered) + self.options.most_names * len(self.moments.by_number)
        known: list[Score] = []
        laplace = sided = self._on_best_sides(laplace)
        while True:
            found = self._proposed(laplace, known)
            best = self._best(laplace, found) if len(laplace.fitted.effects) <= most else None
            if best is not None:
                laplace, odds = best
                entered |= {one.base: odds for one in laplace.fitted.effects if one.base not in entered}
                if copies_in_a_row(laplace.fitted):  # which the detector makes: more would follow
                    return laplace, found
            # A better model has smaller errors, which show sides apart.
            elif laplace is sided or (sided := self._on_best_sides(laplace)) is laplace:
                return laplace, found
            else:
                laplace = sided

    # -- fits ------------------------------------------------------------------------------------

    def _misses(self, laplace: Laplace) -> bool:
        """Whether a fit misses something significant."""
        return Optimum(self.cube.training, laplace.fitted).excess.significance > self.options.sure

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
        covariance = laplace.posterior.covariance.alone(laplace.misfit * laplace.alike_px)
        posterior = replace(laplace.posterior, covariance=covariance)
        return posterior.minimised(laplace.x, FIRST, roughly=True)

    def _on_best_sides(self, laplace: Laplace) -> Laplace:
        """The fit with what has a distance and a direction begun elsewhere, as often as that is likelier."""
        while self._misses(laplace) and (other := self._turned(laplace)) is not None:
            laplace = self._settled(other)
        return laplace

    def _turned(self, laplace: Laplace) -> Laplace | None:
        """A likelier fit that begins on another side, where there is one.

        To first order opposite sides are degenerate, and where it has come to rest the image has a kink. An
        error of the model, which grows by what a wrong side misses, would hide that: here there is none. All
        else follows first, with the derivatives that it has, or the kink would draw back what has just begun
        elsewhere.
        """
        fitted, posterior, sharp = laplace.fitted, laplace.posterior, laplace.posterior.sharp
        sides = on_other_sides(fitted.problem.effects, fitted.problem.layout.effect_values, fitted.x)

        following = ordered_map(
            lambda side: sharp.descended(side[1], 1, roughly=True, held=side[2], slopes=laplace.columns),
            sides,
        )
        promising = sorted(following, key=lambda one: one[1])[:SIDES]
        ends = ordered_map(lambda one: sharp.descended(one[0], TURNED, roughly=True), promising)
        self.report(len(ends))
        x, value, _ = min(ends, key=lambda one: one[1], default=(laplace.x, math.inf, None))
        if value >= sharp.left(laplace.x)[1]:
            return None
        other = posterior.minimised(x, AGAIN, roughly=True)
        return other if other.log_evidence > laplace.log_evidence + PROMISING else None

    def _best(self, laplace: Laplace, found: Sequence[Score]) -> tuple[Laplace, float] | None:
        """The fit with the effect of the best odds, and these; None if no effect is worth it.

        The next is fitted where the fit of the one before falls short of what it promises. What enters may
        make the error of the model smaller: in the end either model has the errors that suit it best.
        """
        best, odds, inflation = None, -math.inf, 1.0
        for score in [one for one in found if one.log_odds > PROMISING][:LOOKED_AT]:
            if odds < score.log_odds and (other := self._joined(laplace, score)) is not None:
                own = max(1.0, score.inflation)
                gain = (other.log_evidence - laplace.log_evidence) / own
                if gain > odds:
                    best, odds, inflation = other, gain, own
        self.report(1)
        if best is None:
            return None
        known = {*laplace.fitted.problem.effects.labels}
        label = next(one for one in best.fitted.problem.effects.labels if one not in known)
        best = self._settled(self._in_best_form(best, label, wider=True))
        odds = (best.log_evidence - laplace.log_evidence) / inflation
        return (best, odds) if odds >= WORTH else None

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

    def _in_best_forms(self, laplace: Laplace, known: Container[str], *, wider: bool) -> Laplace:
        """The fit with each effect that is not `known` in its best form, settled where one changes."""
        found, labels = laplace, laplace.fitted.problem.effects.labels
        for label in labels if wider else reversed(labels):
            if label not in known:
                found = self._in_best_form(found, label, wider=wider)
        return laplace if found is laplace else self._settled(found)

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
            if not isinstance(base, PupilPlace) or base.lit(values):
                tried.append(FixedEffect(base, values, free).only_in(score.candidate.acts_in))
        found = scored(laplace, score.trials, (score.candidate.acts_in,), tried) if tried else []
        better = max([best, *found], key=lambda one: one.log_odds)
        if better is best:
            step *= FINER
        else:
            best, at = better, better.candidate.all_values(better.candidate.null_values).numpy()
    return replace(best, trials=score.trials, log_odds=best.log_odds - math.log(score.trials))
