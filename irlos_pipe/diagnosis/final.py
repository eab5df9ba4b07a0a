"""From the last fit of everything to names: what has the odds, and what explains as much in its place.

The modes beyond the closed basis are known from here on, and effects with odds against them are left out: the
posterior is linear about its optimum for that.
"""

import math
from collections.abc import Container, Sequence
from dataclasses import replace
from functools import cached_property, reduce

import torch

from irlos_pipe.diagnosis.acceptance import (
    DECIDED,
    Accepted,
    Comparison,
    Search,
    gap_between,
    preference,
)
from irlos_pipe.diagnosis.checks import MOVING, motion_ratio
from irlos_pipe.diagnosis.cube import Cube
from irlos_pipe.diagnosis.fitting import Fitted, Fitter
from irlos_pipe.diagnosis.grade import AT_ITS_PLACE, share_at_its_place
from irlos_pipe.diagnosis.null_model import SURE, Optimum, gaussian_sigma
from irlos_pipe.diagnosis.posterior import Laplace, Linear, fitted_as
from irlos_pipe.diagnosis.records import Alternative, Ranked
from irlos_pipe.diagnosis.scores import Score, whitened_shapes
from irlos_pipe.effects import Effect, in_other_forms
from irlos_pipe.effects.base import label_of
from irlos_pipe.estimate.score_test import LinearEstimate

WORTH = 10.0  # ln odds from which an effect enters the model
MOST_RIVALS = 2  # that are told besides a name
JOINTLY = 8  # iterations of a fit with an effect more or less


class Final:
    """The last fit, the modes beyond the closed basis known, without the effects that are dispensable."""

    def __init__(
        self, cube: Cube, fitter: Fitter, laplace: Laplace, declared: Container[str], sure: float, kind: str
    ):
        self.cube, self.laplace, self.sure, self.kind = cube, laplace, sure, kind
        self.conditions = fitter.views[0].conditions
        self._shapes: dict[int, torch.Tensor] = {}
        self.all_modes = laplace.fitted
        self.linear = self._without_dispensable(declared)
        present = (one for one in self.all_modes.problem.effects.labels if one not in self.linear.gone)
        self.beyond = [label for label in present if label not in declared]
        closed = len(fitter.views[0].psf.nolls)
        nolls = self.all_modes.problem.layout.nolls
        beyond = dict(zip(nolls[closed:], self.linear.x[closed : len(nolls)].tolist(), strict=True))
        views = [view.with_known(beyond) for view in fitter.views] if beyond else ()
        self.fitter = fitter.of(cube.training, views)
        self.rows = [i for i in range(len(self.linear.x)) if not closed <= i < len(nolls)]
        self.fitted = self._reduced(self.linear)

    def _without_dispensable(self, declared: Container[str]) -> Linear:
        """The model without effects whose odds are against them, the least likely first.

        Of what blurs, frames that show no motion leave what a detector does, and the other way round.
        """
        linear = self.laplace.linear()
        labels = [one for one in self.all_modes.problem.effects.labels if one not in declared]
        training, right = self.cube.training, ""
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
        laplace = self.laplace
        flat, misfit = laplace.posterior.covariance.flat_rms, max(1.0, laplace.misfit)
        return Optimum(self.cube.training.with_errors(flat, misfit, laplace.alike_px), self.fitted)

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
            problem, solution, self.cube.training, self.fitter.views, image, laplace.columns[rows]
        )

    # -- names -----------------------------------------------------------------------------------

    def named(self, search: Search, entered: dict[Effect, float], found: list[Score]) -> Search:
        """The search with its names: what has the odds, explains its own, and no held-out data object to.

        `entered` are the odds with which effects entered the model, `found` the last scores of all others.
        """
        likely = [one for label in self.beyond if (one := self._likely(label, entered)) is not None]
        likely = sorted(likely, key=lambda one: (one.ordinary, -one.gain))
        names = [self._with_rivals(one, found) for one in likely if self._is_sure(one)]
        return replace(
            search,
            final=self.optimum,
            accepted=names,
            scores=found,
            adjusted=sorted({*self.beyond} - {one.label for one in names}),
            nearest=None if names else next(iter(likely), None),
            tolerant=True,
        )

    def _likely(self, label: str, entered: dict[Effect, float]) -> Accepted | None:
        """An effect whose odds are for a name, compared with the model without it; or None."""
        odds = entered.get(self.all_modes.effect(label).base, math.inf)
        if not min(self.log_odds(label), odds) > SURE:
            return None
        one, stack = self.compared(label), self.cube.held_out
        z = preference(stack, one.fitted, one.origin.fitted)
        gap = gap_between(stack, one.origin.fitted, one.fitted)
        ranking = [Ranked(one.name, one.gain, one.explained, one.significance, 0.0)]
        return Accepted(one.origin, one.fitted, label, one.significance, z, gap, ranking=ranking)

    def _is_sure(self, one: Accepted) -> bool:
        """Whether a likely effect is named."""
        # Copies of the star lie near its core, where the model's error counts in their odds.
        share = 1.0 if one.base.copies_star else share_at_its_place(one, self.optimum)
        # What every model has free never had to enter: frames that no fit has seen decide for it. Of images
        # that hardly differ, as by modes beyond the basis, the preference is a normal deviate.
        always_free = one.base.fact or one.base.mild
        agreed = one.preference >= (DECIDED if always_free else -DECIDED)
        sure = one.significance >= self.sure and share >= AT_ITS_PLACE[self.kind]
        return sure and agreed and not one.base.unusual(one.values)

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

    def compared(self, label: str) -> Comparison:
        """The model with an effect beside that without it."""
        stack = self.optimum.stack
        if not self.linear.nulls_of(label):
            others = self.fitted.continued_by_label()
            del others[label]
            origin = Optimum(stack, self.fitter.explored([*others.values()], self.fitted))
            return self._beside(origin, self.fitted, label)
        origin = Optimum(stack, self._reduced(self.linear.without(label)))
        frames = math.inf if stack.photon_limited else stack.independent
        count = len(self.fitted.effect(label).parameters)
        sigma = gaussian_sigma(self.linear.rise_without(label), count, frames)
        return Comparison(origin, self.fitted, label, sigma)

    @staticmethod
    def _beside(origin: Optimum, fitted: Fitted, label: str) -> Comparison:
        more = len(fitted.effect_values) - len(origin.fitted.effect_values)
        return Comparison(origin, fitted, label, origin.significance_of_change(fitted, more))

    # -- rivals ----------------------------------------------------------------------------------

    def _with_rivals(self, one: Accepted, found: Sequence[Score]) -> Accepted:
        """A name with what would explain as much in its place."""
        rivals = self._rivals(one, found)
        alternatives = [
            Alternative(other.name, f"it explains as much (|cos| {cosine:.3f})", one.base.look_alike, cosine)
            for other, cosine in rivals
        ]
        ranking = list(one.ranking)
        for other, _ in rivals:
            z = preference(self.cube.held_out, one.fitted, other.fitted)
            ranking.append(Ranked(other.name, other.gain, other.explained, other.significance, z))
        return replace(one, alternatives=alternatives, ranking=ranking, rivals=[other for other, _ in rivals])

    def _rivals(self, one: Comparison, found: Sequence[Score]) -> list[tuple[Comparison, float]]:
        """Fits of effects that would explain as much in the place of one, with their |cos|.

        They are wider forms of it, those `found` that the model never had, and those that were dispensable
        beside it.
        """
        label, laplace = one.label, self.laplace
        if not self.linear.nulls_of(label):
            return []
        rise, null = self.linear.rise_without(label), laplace.null_of(self.linear.without(label))
        effects = self.all_modes.continued_by_label()
        rivals: list[tuple[Effect, float]] = []
        for score in found:
            if score.candidate.base.needs_search or score.name == one.name or not score.usable:
                continue
            linear = LinearEstimate.of(null, score.candidate, self._shapes_of(score.candidate))
            if linear.usable.any():
                rivals.append((score.start(), rise - linear.gain))
        for gone in self.linear.gone:
            others = (other for other in self.linear.gone if other != gone)
            with_it = reduce(Linear.without, others, laplace.linear())
            rivals.append((effects[gone], with_it.rise_without(label)))
        if one.base.acts_in is None:  # what acts in some moments alone has no wider forms
            forms = in_other_forms(one.name, self.conditions, one.values, wider=True)
            rivals += [(form, 0.0) for form in forms]
        fits, origin = [], one.origin.fitted
        for effect, left in sorted(rivals, key=lambda rival: rival[1])[:MOST_RIVALS]:
            if left < 2 * WORTH:
                fitted = self.fitter.explored([*origin.continued(), effect], origin)
                known = sum(other.name == effect.name for other in origin.effects)
                cosine = math.sqrt(max(1 - max(left, 0.0) / rise, 0.0))
                fits.append((self._beside(one.origin, fitted, label_of(effect.name, known)), cosine))
        return fits

    def _shapes_of(self, candidate: Effect) -> torch.Tensor:
        """Its whitened derivatives, which every name is compared with."""
        if id(candidate) not in self._shapes:
            self._shapes[id(candidate)] = whitened_shapes(self.laplace, [candidate])[0]
        return self._shapes[id(candidate)]
