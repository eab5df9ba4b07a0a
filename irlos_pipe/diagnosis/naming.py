"""Names in a search where facts are free: further ones, and those that a model needs in the end.

A name must be significant, leave little of its own signal where it acts, and be wanted by data that no fit
has seen. What another effect explains as well, and more plausibly, gives that its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Self

import numpy as np

from irlos_pipe.diagnosis.acceptance import PREFERRED, Accepted, accepted
from irlos_pipe.diagnosis.allowance import KNOWN, AllowingTask
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.diagnosis.grade import AT_ITS_PLACE, share_at_its_place
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.refit import Refit, other_forms, quick_refits
from irlos_pipe.diagnosis.search.scores import Family, Score, score_family
from irlos_pipe.diagnosis.without import imitated, without_linearly
from irlos_pipe.effects import CATALOGUE, Effect
from irlos_pipe.effects.base import label_after
from irlos_pipe.effects.effect_set import labels_of
from irlos_pipe.numerics.parallel import ordered_map

RIVALS = 0.3  # of the fall of χ² by a name, that another must promise to be compared
PROPOSALS = 4  # fitted per name
HARDLY_SEEN = 2.0  # significance of a score from which it is fitted where the model misfits


class NamingTask(AllowingTask):
    """A search that gives names beside variances that allow for what its model misses."""

    def further(self, current: Optimum, found: list[Score], least: float) -> Accepted | None:
        """The next name: significant, plausible, and wanted by the held-out frames.

        Parameters
        ----------
        current : Optimum
            The model without it.
        found : list of Score
            Of the effects there.
        least : float
            Part of χ² that a name must explain which leaves much where it acts.
        """
        places = [other for score in found if score.candidate.copies_star for other in score.elsewhere]
        least_seen = HARDLY_SEEN if self.misfit > KNOWN else self.options.sure
        seen = [one for one in (*found, *places) if one.significance > least_seen]
        ranked = quick_refits(
            self.fitter, current, sorted(seen, key=lambda one: -one.significance)[:PROPOSALS]
        )
        self.report(len(ranked))
        ranked = [one for one in ranked if not one.implausible]
        right = self._wanted([one for one in ranked if self._explains_its_own(one)])
        return right or self._wanted([one for one in ranked if one.gain > least * one.origin.fitted.chi2])

    def _wanted(self, ranked: Sequence[Refit]) -> Accepted | None:
        """The first of the ranked names if it is significant and held-out data clearly prefer it.

        Beside errors of a model they must prefer it clearly on sky, too: chance companions in what is left
        are significant and mean nothing there.
        """
        one = accepted(ranked, self.cube, self.options)
        return one if one is not None and one.preference > PREFERRED else None

    def _explains_its_own(self, refit: Refit) -> bool:
        """Whether a name leaves little where it acts; one that leaves much stands in for something else."""
        return share_at_its_place(refit, refit.optimum) > AT_ITS_PLACE[self.kind]

    def confirmed(
        self, current: Optimum, told: Sequence[Effect], dropped: Sequence[str]
    ) -> tuple[Self, Optimum, list[Accepted]]:
        """Names for the effects of a model that explain their own and that it needs, also for held-out data.

        One that another effect explains as well, and more plausibly, gives it its place. What is unusual
        comes first, then what explains most.

        Parameters
        ----------
        current : Optimum
            The model.
        told : sequence of Effect
            Its effects that need no name.
        dropped : sequence of str
            Names that were not significant beside these.
        """
        named: list[Accepted] = []
        task, waiting = self, self._sure(current, told)
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
            one = task._wanted(sorted(plausible, key=lambda one: -one.merit))
            if one is None:
                continue
            if one.refit is not present:
                task, current = task.with_errors(one.refit.fitted)
                waiting = [label_after(other, label) for other in waiting]
                named = [replace(other, label=label_after(other.label, label)) for other in named]
            named.append(replace(one, label=one.refit.label))
        return task, current, sorted(named, key=lambda one: (one.ordinary, -one.refit.gain))

    def _sure(self, current: Optimum, told: Sequence[Effect]) -> list[str]:
        """Labels of the effects beyond those told that all visible modes together do not imitate.

        The modes beyond the closed basis are known to a model, as a fit beside its effects has them: without
        an effect that they imitate it fits badly, whether or not that effect is there.
        """
        labels = added(current.fitted, told)
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


def added(fitted: Fitted, told: Sequence[Effect]) -> list[str]:
    """Labels of the effects of a model beyond those that it was told.

    Parameters
    ----------
    fitted : Fitted
    told : sequence of Effect
    """
    known = {*labels_of(told)}
    return [label for label in fitted.problem.effects.labels if label not in known]
