"""Names in a search where facts are free: further ones, and those that a model needs in the end.

A name must be significant, leave little of its own signal where it acts, and be preferred by data that no fit
has seen. What another effect explains as well, and more plausibly, gives that its place.

The wavefront is as open as the window, and variances allow for what the model misses. Light that a model has
in the wrong place is no noise: names earned by it are none. What a model misses is measured, as χ²/ν and as
fine structure that only the flat explains, and enters the variances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from irlos_pipe.conventions.units import resolution_px
from irlos_pipe.diagnosis.acceptance import PREFERRED, Accepted, accepted
from irlos_pipe.diagnosis.checks.fine_structure import flat_rms
from irlos_pipe.diagnosis.checks.noise import PHOTONS
from irlos_pipe.diagnosis.cube import Errors, Stacks
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.diagnosis.forward import Task
from irlos_pipe.diagnosis.grade import AT_ITS_PLACE, share_at_its_place
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.opening import Opening
from irlos_pipe.diagnosis.refit import Refit, other_forms, quick_refits
from irlos_pipe.diagnosis.search.scores import Family, Score, score_family
from irlos_pipe.diagnosis.without import imitated, without_linearly
from irlos_pipe.effects import CATALOGUE, Effect
from irlos_pipe.effects.base import label_after
from irlos_pipe.effects.effect_set import labels_of
from irlos_pipe.numerics.parallel import ordered_map
from irlos_pipe.optics.psf_settings import PsfSettings

KNOWN = 1.2  # χ²/ν up to which photons still set the errors


@dataclass(frozen=True)
class AllowingTask(Task):
    """A search with variances that allow for what a model misses."""

    kind: str  # of the noise
    # Error of the flat, the least that a model left: a wrong one makes fine structure of its own.
    flat_rms: float = np.inf
    misfit: float = np.inf  # χ²/ν for which the variances allow
    # The last fit of all visible modes, of which the light paths have those beyond the closed basis.
    all_modes: Opening | None = None

    def with_errors(self, fitted: Fitted) -> tuple[Self, Optimum]:
        """The search that allows for what a model misses, and the model fitted again under it."""
        task = self.allowing(fitted)
        again = task.fitter.explored(fitted.continued(), fitted)
        fitted = again if np.isfinite(again.chi2) else fitted
        task = task.allowing(fitted)
        self.report(1)
        return task, Optimum(task.cube.training, task.fitter.at(fitted))

    def allowing(self, fitted: Fitted) -> Self:
        """The same search with variances that allow for what a model misses."""
        errors = self.errors_of(fitted)
        known = self.kind == PHOTONS and errors.misfit < KNOWN
        cube = self.cube.with_errors(errors).limited_by(known)
        fitter = self.fitter.of(cube.training)
        return replace(self, cube=cube, fitter=fitter, flat_rms=errors.flat_rms, misfit=errors.misfit)

    def errors_of(self, fitted: Fitted) -> Errors:
        return errors_of(self.cube.training, fitted, self.conditions.settings, self.flat_rms)

    def opened(self, current: Optimum) -> tuple[Self, Optimum]:
        """The search, and its model, with the wavefront beyond the fitted modes as all visible modes have it.

        One fit of all modes finds it; from there on it is known, which keeps every further fit as quick as
        before. Several recordings keep the modes that they have.
        """
        opening = self.opening(current.fitted, current.fitted.continued())
        return (self, current) if opening is None else self.closed(opening)

    def opening(self, near: Fitted, effects: Sequence[Effect]) -> Opening | None:
        """A fit of all visible modes jointly with some effects, see `Opening.of`."""
        before = self.all_modes
        known_nm, law = ({}, None) if before is None else (before.beyond_nm, before.law)
        unknown = {noll: -nm for noll, nm in known_nm.items()}
        views = [view.with_known(unknown) for view in self.fitter.views]
        fitter = self.fitter.of(self.cube.training, views)
        return Opening.of(fitter, effects, near, known_nm, law)

    def closed(self, opening: Opening) -> tuple[Self, Optimum]:
        """The search, and its model, with the modes beyond the closed basis as a fit of all has them."""
        known = opening.with_known_modes()
        fitter = self.fitter.of(self.cube.training, known.views)
        task = replace(self, fitter=fitter, all_modes=opening)
        return task.with_errors(task.fitter.at(known))


def errors_of(stack: Stacks, fitted: Fitted, settings: PsfSettings, most_flat: float = np.inf) -> Errors:
    """What flat and model miss, with which in the variances χ²/ν is one.

    The error of the flat is `most_flat` at most; the `settings` are those of the first recording.
    """
    residual_e = stack.mean_e - fitted.image_e
    pairs = zip(stack.parts, fitted.problem.pixels, strict=True)
    flat = min(most_flat, max(flat_rms(part, residual_e[pixels], settings) for part, pixels in pairs))
    across_px = resolution_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)
    errors = Errors(alike_px=max(1.0, np.pi / 4 * across_px**2), flat_rms=flat)
    white = residual_e * stack.with_errors(errors).root
    return replace(errors, misfit=max(1.0, float(white @ white) / fitted.problem.freedom))


RIVALS = 0.3  # part of a name's fall of χ² that another effect must promise to be compared with it
PROPOSALS = 4  # effects that are fitted per name
HARDLY_SEEN = 2.0  # significance of a score from which it is fitted where the model misfits


class NamingTask(AllowingTask):
    """A search that gives names with variances that allow for what its model misses."""

    def further(self, current: Optimum, found: list[Score], least: float) -> Accepted | None:
        """The next name: significant, plausible, and preferred by the held-out frames.

        The `current` model lacks it; the scores of effects `found` there. A name that leaves much where it
        acts must explain at `least` this part of χ².
        """
        places = [other for score in found if score.candidate.copies_star for other in score.elsewhere]
        least_seen = HARDLY_SEEN if self.misfit > KNOWN else self.options.sure
        seen = [one for one in (*found, *places) if one.significance > least_seen]
        ranked = quick_refits(
            self.fitter, current, sorted(seen, key=lambda one: -one.significance)[:PROPOSALS]
        )
        self.report(len(ranked))
        ranked = [one for one in ranked if not one.implausible]
        right = self._preferred([one for one in ranked if self._explains_its_own(one)])
        return right or self._preferred([one for one in ranked if one.gain > least * one.origin.fitted.chi2])

    def _preferred(self, ranked: Sequence[Refit]) -> Accepted | None:
        """The first of the ranked names if it is significant and held-out data clearly prefer it.

        With errors of a model they must prefer it clearly on sky, too: chance companions in the residual are
        significant and mean nothing there.
        """
        one = accepted(ranked, self.cube, self.options)
        return one if one is not None and one.preference > PREFERRED else None

    def _explains_its_own(self, refit: Refit) -> bool:
        """Whether a name leaves little where it acts; one that leaves much stands in for something else."""
        return share_at_its_place(refit, refit.optimum) > AT_ITS_PLACE[self.kind]

    def confirmed(
        self, current: Optimum, declared: Sequence[Effect], dropped: Sequence[str]
    ) -> tuple[Self, Optimum, list[Accepted]]:
        """Names for the effects of a model that explain their own and that it needs, also for held-out data.

        Effects `declared` need no name; those `dropped` were not significant jointly with the others. A name
        that another effect explains as well, and more plausibly, gives it its place. What is unusual comes
        first, then what explains most.
        """
        named: list[Accepted] = []
        task, waiting = self, self._sure(current, declared)
        while waiting:
            label, *waiting = waiting
            present = task._against_without(current, label)
            if not np.isfinite(present.origin.fitted.chi2):
                continue
            right = task._explains_its_own(present)
            rivals = (
                task._rivals(present, dropped) if right else other_forms(task.fitter, [present], wider=True)
            )
            plausible = [one for one in (present, *rivals) if task._explains_its_own(one)]
            one = task._preferred(sorted(plausible, key=lambda one: -one.merit))
            if one is None:
                continue
            if one.refit is not present:
                task, current = task.with_errors(one.refit.fitted)
                waiting = [label_after(other, label) for other in waiting]
                named = [replace(other, label=label_after(other.label, label)) for other in named]
            named.append(replace(one, label=one.refit.label))
        return task, current, sorted(named, key=lambda one: (one.ordinary, -one.refit.gain))

    def _sure(self, current: Optimum, declared: Sequence[Effect]) -> list[str]:
        """Labels of the effects beyond those declared that all visible modes jointly do not imitate.

        The modes beyond the closed basis are known to a model, as a joint fit with its effects has them:
        without an effect that they imitate it fits badly, whether or not that effect is there.
        """
        labels = added(current.fitted, declared)
        if self.all_modes is None:
            return labels
        fitted = self.all_modes.fitted
        stack = self.allowing(fitted).cube.training
        beside = [label for label in labels if label in fitted.problem.effects.labels]
        unsure = imitated(fitted, beside, stack, self.options.sure)
        return [label for label in labels if label not in unsure]

    def _rivals(self, refit: Refit, dropped: Sequence[str]) -> list[Refit]:
        """Fits of what may explain the same: of the dropped, and where it is unusual of all effects."""
        if refit.base.ordinary(refit.values):
            kinds = [CATALOGUE[name] for name in dropped if name != refit.name]
            tried = [Family(one.variants(self.conditions)) for one in kinds]
            found = ordered_map(partial(score_family, refit.origin), tried)
        else:
            found = [one for one in self._scores(refit.origin)[0] if one.name != refit.name]
        near = [one for one in found if one.testable and one.gain > RIVALS * refit.gain]
        likely = sorted(near, key=lambda one: -one.gain)[:PROPOSALS]
        others = quick_refits(
            self.fitter, refit.origin, likely
        )  # among them wider forms: of `refit`'s own name
        forms = [one for wider in (True, False) for one in other_forms(self.fitter, [refit], wider=wider)]
        return [*forms, *(one for one in others if one.name not in {refit.name, refit.base.widens})]

    def _against_without(self, current: Optimum, label: str) -> Refit:
        """The model against itself without one effect."""
        fitted = current.fitted
        near = without_linearly(fitted, label)
        effects = near.continued_by_label()
        name = effects.pop(label).name
        origin = Optimum(current.stack, self.fitter.explored(list(effects.values()), near))
        kind = CATALOGUE[name]
        variants = (
            kind.variants(self.conditions) if kind.found_by == "score" else (fitted.effect(label).base,)
        )
        where = fitted.effect(label).acts_in
        family = Family(tuple(one.only_in(where) for one in variants), placements=(where,))
        return Refit(score_family(origin, family), origin, fitted, label)


def added(fitted: Fitted, declared: Sequence[Effect]) -> list[str]:
    """Labels of the effects of a model beyond those declared."""
    known = {*labels_of(declared)}
    return [label for label in fitted.problem.effects.labels if label not in known]
