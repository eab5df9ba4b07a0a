"""The search where nothing is exactly as declared: facts of the instrument free, errors of the model allowed.

At a telescope the pupil, the scale, the band and the wavefront all differ a little from what a profile
states, and there is a little of every mild effect. One name after the other then explains little, and every
one of them stands in for the others. Here facts and mild effects are fitted jointly, the wavefront is taken
as far as the window sees it, and what the model still misses enters the variances, so that no name is earned
by what everything misses. What has a place is looked for jointly with all that. Last, dispensable effects are
taken out, and the others are named if held-out frames prefer them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from irlos_pipe.diagnosis.acceptance import Search
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.diagnosis.grade import copies_in_a_row
from irlos_pipe.diagnosis.naming import NamingTask, added
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.opening import Opening
from irlos_pipe.diagnosis.refit import FAR, PER_PARAMETER
from irlos_pipe.diagnosis.search.scores import Score
from irlos_pipe.diagnosis.significance import threshold
from irlos_pipe.diagnosis.starts import off_rest, on_other_sides, other_wavefronts
from irlos_pipe.diagnosis.without import needless
from irlos_pipe.effects import CATALOGUE, Conditions, Effect, FixedEffect, in_other_forms
from irlos_pipe.effects.colour import STRETCH, PlateScale, Spectrum
from irlos_pipe.effects.effect_set import labels_of
from irlos_pipe.numerics.parallel import ordered_map

OPENINGS, TURNED = 4, 1  # of the wavefront at most; the one from which effects begin on other sides, too
CONVERGED = 0.8  # ratio of χ²/ν to that before, above which another round is not worth it
MOST = 0.5  # part of χ² that a name must explain which leaves much where it acts, while more is wrong
LOOKED_AT, NEARLY = 2, 0.5  # effects fitted with all modes; part of the best one's gain that they promise
SCALES = (PlateScale.name, Spectrum.name)  # both scale the image and are nearly degenerate


@dataclass(frozen=True)
class TolerantTask(NamingTask):
    """A search with the facts of the instrument free, besides what the model has."""

    beside_modes: Sequence[Score] = ()  # of the effects that it lacked, of which the modes imitate a part

    def beyond(self, search: Search, effects: Sequence[Effect]) -> Search:
        """Begin again from `effects` where a plain `search` left much: facts first, then names.

        The wavefront is opened after the facts, as many modes imitate whatever is small and bright. Names are
        given last.
        """
        declared = [*effects, *self._moving(search)]
        task = self.allowing(search.final.fitted)
        task, current = task.with_errors(task._base(declared, search))
        task, current = task._named(current, MOST)
        task, current = task._converged(current, declared)
        task, current = task.with_errors(task._turned(current.fitted))
        full = [*added(current.fitted, declared), *SCALES]
        task, current = task.with_errors(task._without_dispensable(current, declared))
        present = labels_of(current.fitted.effects)
        dropped = [name for name in dict.fromkeys(full) if name not in present and name in CATALOGUE]
        task, current, named = task.confirmed(current, declared, dropped)
        finished = task.fitter.finished(current.fitted)
        if np.isfinite(finished.chi2):
            current = Optimum(task.cube.training, finished)
        others, meaningless = task._scores(current, but=[one.name for one in task.beside_modes])
        found = [*task.beside_modes, *others]
        adjusted = sorted(set(added(current.fitted, declared)) - {one.label for one in named})
        nearest = None if named else next(iter(search.accepted), None)
        return Search(
            search.null,
            current,
            search.drift,
            named,
            found,
            meaningless,
            adjusted,
            nearest,
            task.all_modes,
            tolerant=True,
        )

    def _moving(self, search: Search) -> list[Effect]:
        """The drift, if it is significant."""
        drift = search.drift
        return [self._drifting(drift)] if drift and drift.significance > self.options.sure else []

    def _named(self, current: Optimum, least: float = 0.0) -> tuple[TolerantTask, Optimum]:
        """The search and its model with further names; they are judged in the end, jointly with all others.

        Names that leave little where they act come first; others must explain a `least` part of what is left.
        """
        task = self
        for _ in range(self.options.most_names):
            if copies_in_a_row(current.fitted):
                break
            chosen = task.further(current, task._scores(current)[0], least)
            if chosen is None:
                break
            task, current = task.with_errors(chosen.refit.fitted)
        return task, current

    # -- steps ---------------------------------------------------------------------------------

    def _base(self, declared: Sequence[Effect], search: Search) -> Fitted:
        """The fit with all facts free, and with what a plain search found if that helps."""
        near = search.final.fitted
        plain = near.continued()
        sets = [declared, plain] if len(plain) > len(declared) else [declared]
        conditions = [view.conditions for view in self.fitter.views]
        whole = [[*some, *everyday(conditions, some)] for some in sets]
        first = ordered_map(lambda effects: self.fitter.explored(effects, near), whole)
        self.report(len(first))
        best = min(first, key=lambda one: one.chi2 + self._price(one))
        return self._turned(best) if np.isfinite(best.chi2) else near

    def _turned(self, fitted: Fitted) -> Fitted:
        """The best of a fit and others in which what has a distance and a direction begins elsewhere.

        A stop that began on the wrong side of the pupil comes to rest at its centre, where the image has a
        kink, or stays there: to first order opposite sides are degenerate.
        """
        found = ordered_map(lambda turned: self.fitter.explored(turned, fitted), on_other_sides(fitted))
        self.report(len(found))
        return min([fitted, *found], key=lambda one: one.chi2)

    def _turned_with_all_modes(self, opening: Opening) -> Opening:
        """The best of all modes with the effects as they are, and with some that begin elsewhere."""
        fitted = opening.fitted
        found = ordered_map(lambda turned: self.opening(fitted, turned), on_other_sides(fitted))
        self.report(len(found))
        return min([opening, *(one for one in found if one is not None)], key=self._deviance)

    def _started_elsewhere(self, current: Optimum) -> tuple[TolerantTask, Optimum]:
        """The search and its model from the most plausible of several starts: this may be a false minimum."""
        effects = current.fitted.continued()
        starts = other_wavefronts(current.fitted, self.options.begin_near_nm)
        found = [current.fitted, *(self.fitter.explored(effects, one) for one in starts)]
        self.report(len(starts))
        best = self.fitter.most_plausible([one for one in found if np.isfinite(one.chi2)])
        return (self, current) if best is current.fitted else self.opened(self.with_errors(best)[1])

    def _converged(self, current: Optimum, declared: Sequence[Effect]) -> tuple[TolerantTask, Optimum]:
        """The search and its model with the wavefront open, until χ²/ν falls no more.

        Names are looked for until none is found, each time that the wavefront is opened.
        """
        task = self
        for number in range(OPENINGS):
            misfit = task.misfit
            opening = task.opening(current.fitted, task._begun(current.fitted))
            if opening is None:
                return task._named(current)
            opening = task._without_imitated(opening, declared)
            opening = task._turned_with_all_modes(opening) if number >= TURNED else opening
            opening, found = task._named_with_all_modes(opening)
            task, current = replace(task, beside_modes=found).closed(opening)
            if number == 0 and task.misfit > FAR:
                task, current = task._started_elsewhere(current)
            steady = task.misfit > CONVERGED * misfit
            if steady or copies_in_a_row(current.fitted):  # which the detector makes: more would follow
                break
        return task, current

    def opening(self, near: Fitted, effects: Sequence[Effect]) -> Opening | None:
        """The band is as wide as declared where the pixels are free."""
        return super().opening(near, as_wide_as_declared(effects))

    def _begun(self, fitted: Fitted) -> list[Effect]:
        """The effects from where they are; what rests begins at a distance where all modes prefer one."""
        effects = fitted.continued_by_label()
        return [*effects.values()] if self.all_modes is None else off_rest(self.all_modes.fitted, effects)

    def _without_imitated(self, opening: Opening, declared: Sequence[Effect]) -> Opening:
        """All modes without those effects of the wavefront, found before, that they imitate."""
        effects = opening.fitted.continued_by_label()
        found = [label for label in added(opening.fitted, declared) if _of_the_wavefront(effects[label])]
        imitated = needless(opening.fitted, found, self.cube.training, self.options.sure)
        if not imitated:
            return opening
        left = [effect for label, effect in effects.items() if label not in imitated]
        self.report(1)
        return self.opening(opening.fitted, left) or opening

    def _named_with_all_modes(self, opening: Opening) -> tuple[Opening, list[Score]]:
        """All modes with further effects that they imitate, but would rather not; scores of all others."""
        found = self._scores_with_all_modes(opening)
        for _ in range(self.options.most_names):
            further = None if copies_in_a_row(opening.fitted) else self._behind(opening, found)
            if further is None:
                break
            opening, found = further, self._scores_with_all_modes(further)
        return opening, found

    def _scores_with_all_modes(self, opening: Opening) -> list[Score]:
        """Scores with all modes and variances that allow for what these miss, which is often far less."""
        return self._scores(opening.optimum(self.allowing(opening.fitted).cube.training))[0]

    def _behind(self, opening: Opening, found: Sequence[Score]) -> Opening | None:
        """All modes with the further effect with which χ² and priors fall most; None if none is seen."""
        seen = [one for one in found if one.testable and one.significance > self.options.sure]
        likely = sorted(seen, key=lambda one: -one.gain / one.inflation)[:LOOKED_AT]
        likely = [one for one in likely if one.gain > NEARLY * likely[0].gain]
        with_one = ordered_map(partial(self._with_all_modes, opening), likely)
        self.report(len(likely))
        best, most = None, 0.0
        for one, score in zip(with_one, likely, strict=True):
            least = threshold(len(score.usable), score.trials) * score.inflation
            fall = 0.0 if one is None else self._deviance(opening) - self._deviance(one)
            if one is not None and fall > max(least, most):
                best, most = (one, score, least), fall
        return best and self._in_wider_form(*best)

    def _with_all_modes(self, opening: Opening, score: Score) -> Opening | None:
        """All modes with one effect more."""
        return self.opening(opening.fitted, [*opening.fitted.continued(), score.start()])

    def _in_wider_form(self, opening: Opening, score: Score, least: float) -> Opening:
        """All modes with what was found or its wider form: two copies would imitate one out of focus."""
        others = opening.fitted.continued_by_label()
        found = [label for label, effect in others.items() if effect.name == score.name][-1]
        del others[found]
        values = opening.fitted.values_of(found)
        for wider in in_other_forms(score.name, self.conditions, values, wider=True):
            one = self.opening(opening.fitted, [*others.values(), wider])
            self.report(1)
            if one is not None and self._deviance(opening) - self._deviance(one) > least:
                return one
        return opening

    def _deviance(self, opening: Opening) -> float:
        return opening.deviance(self.misfit)

    def _price(self, fitted: Fitted) -> float:
        """What the parameters of a model have to earn of χ²."""
        return PER_PARAMETER * self.cube.training.parts[0].alike_px * fitted.problem.size

    def _without_dispensable(self, current: Optimum, declared: Sequence[Effect]) -> Fitted:
        """The model without effects, unless declared, that are not significant jointly with the others."""
        fitted = current.fitted
        errors = self.errors_of(fitted)
        alone = self.cube.training.with_errors(replace(errors, alike_px=1.0))  # to keep rather than to drop
        dropped = needless(fitted, added(fitted, declared), alone, self.options.sure)
        effects = fitted.continued_by_label()
        return self.fitter.explored([effects[label] for label in effects if label not in dropped], fitted)


def _of_the_wavefront(effect: Effect) -> bool:
    """Whether it is one of those that modes may imitate and that are not to be expected anywhere."""
    return effect.plane == "pupil" and not (effect.base.fact or effect.base.mild)


def everyday(recordings: Sequence[Conditions], present: Sequence[Effect]) -> list[Effect]:
    """Facts of the instrument and mild effects, their values free, but for those that a mode imitates.

    They are stated for the first of the `recordings`. Of the two that scale the image one is free, the pixels
    unless it is `present` as the wavelength: jointly they drift far from what is true, a little here and a
    little there. The other is a rival in the end.
    """
    model, found = {effect.name for effect in present}, []
    pixels, wavelength = SCALES
    held = pixels if wavelength in model else wavelength
    for name, kind in CATALOGUE.items():
        if not (kind.fact or kind.mild) or name in model or name == held:
            continue
        try:
            effect = kind.under(recordings[0])
        except ValueError:
            continue  # it means nothing for this instrument
        if not effect.imitated_in(recordings):
            found.append(effect)
    return found


def as_wide_as_declared(effects: Sequence[Effect]) -> list[Effect]:
    """The effects, the width of the band held as declared if both the pixels and the wavelengths are free.

    Wavefront, wavelengths and pixels may all be larger by one factor, which the image does not show, and the
    priors of many modes would have them smaller. A filter moves, and the scale of a camera changes, more
    easily than the width of a filter.
    """
    if not set(SCALES) <= {effect.name for effect in effects if effect.parameters}:
        return [*effects]
    return [_without_stretch(effect) if effect.name == Spectrum.name else effect for effect in effects]


def _without_stretch(spectrum: Effect) -> Effect:
    """The same wavelengths about their mean."""
    names = [parameter.name for parameter in spectrum.base.parameters]
    values = spectrum.all_values([parameter.start for parameter in spectrum.parameters]).numpy()
    values[names.index(STRETCH)] = 0.0
    free = [parameter.name for parameter in spectrum.parameters if parameter.name != STRETCH]
    return FixedEffect(spectrum.base, values, free)
