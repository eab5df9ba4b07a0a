"""The search for a single name that explains what is missing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from irlos_pipe.diagnosis.acceptance import Accepted, Search, choose
from irlos_pipe.diagnosis.checks.drift import Drift, measure_drift
from irlos_pipe.diagnosis.checks.pixels import bad_pixel_family
from irlos_pipe.diagnosis.cube import Cube
from irlos_pipe.diagnosis.fitting import Fitted, Fitter
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.refit import refits
from irlos_pipe.diagnosis.scores import Family, Score, scores
from irlos_pipe.diagnosis.sharing import parted, seen_in, sharing
from irlos_pipe.diagnosis.view import Moments, Placement
from irlos_pipe.effects import CATALOGUE, Conditions, Effect, FixedEffect

SPLIT = 0.5  # part of what one value for all leaves, that a value for each moment must explain
Report = Callable[[int], None]


@dataclass(frozen=True)
class Task:
    """A cube with the means to fit it."""

    cube: Cube
    fitter: Fitter
    moments: Moments
    options: Options
    report: Report

    @property
    def conditions(self) -> Conditions:
        """Those of the first recording, for which effects are stated."""
        return self.fitter.views[0].conditions

    def searched(self, effects: Sequence[Effect]) -> Search:
        """Find the name that explains what is missing, if a single one does."""
        return self.searched_from(self._null(effects))

    def searched_from(self, fitted: Fitted) -> Search:
        """The same from a fit of the model as it is."""
        null = self._optimum(fitted)
        drift, current = self._with_drift(null)
        found, meaningless = self._scores(current)
        sure, chosen = self.options.sure, None
        if current.excess.significance > sure or any(one.significance > sure for one in found):
            ranked = refits(self.fitter, current, found, self.report)
            chosen = choose(ranked, self.cube, self.options)
        accepted = self._of_each_moment(chosen) if chosen else []
        if accepted:
            current = accepted[-1].refit.optimum
            found, _ = self._scores(current)
        return Search(null, current, drift, accepted, found, meaningless)

    # -- steps ---------------------------------------------------------------------------------

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
        return drift, self._optimum(fitted)

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

    def _of_each_moment(self, chosen: Accepted) -> list[Accepted]:
        """The name, or one with its own value for each moment where one value for all leaves much."""
        refit = chosen.refit
        much = refit.excess.significance > self.options.sure
        if not (self.moments.several and much and refit.base.acts_in is None):
            return [chosen]
        fitted, label = refit.fitted, refit.label
        found = sharing([label], fitted, self.fitter, self.cube, self.moments, self.options.sure)
        if found.finding != "differs" or found.chi2_fall < SPLIT * refit.excess.chi2:
            return [chosen]
        own = self.fitter.explored(parted(seen_in(found, self.moments), fitted, label), fitted)
        of_each = replace(refit, fitted=self.fitter.finished(own))
        known = refit.origin.fitted.problem.effects.labels
        labels = [label for label in of_each.fitted.problem.effects.labels if label not in known]
        return [replace(chosen, refit=replace(of_each, label=label)) for label in labels]

    def _optimum(self, fitted: Fitted) -> Optimum:
        return Optimum(self.cube.training, fitted)


def families(moments: Moments, present: Sequence[Effect]) -> tuple[list[Family], list[str]]:
    """Families for all moments, and of several for single stars or moments, unless `present` there already.

    A wider form of an effect is looked for by itself where it belongs to something else: of several stars a
    companion belongs to one, a ghost to all. Returned as well are the effects that mean nothing under these
    conditions.
    """
    found, meaningless = [], []
    for name, kind in CATALOGUE.items():
        if kind.found_by != "score" or (kind.widens and not _apart(kind, moments)):
            continue
        placements: list[Placement] = [None] if kind.widens else moments.placements(kind)
        open_ = [one for one in placements if kind.repeatable or not _taken(name, one, present)]
        try:
            found += _families(kind, moments, open_)
        except ValueError:
            meaningless.append(name)
    return found, meaningless


def _families(kind: type[Effect], moments: Moments, placements: Sequence[Placement]) -> list[Family]:
    """One family where the effect is the same in all moments, else one for each placement."""
    if kind.belongs_to == "instrument" and None in placements:
        return [Family(kind.variants(moments.conditions_of(None)), placements=placements)]
    found = []
    for where in placements:
        variants = kind.variants(moments.conditions_of(where))
        placed = tuple(one.only_in(where) for one in variants)
        found.append(Family(placed, len(placements), (where,)))
    return found


def _apart(kind: type[Effect], moments: Moments) -> bool:
    """Whether recordings of these moments distinguish a wider form from what it is a wider form of."""
    return len(moments.by_star) > 1 and CATALOGUE[kind.widens].belongs_to != kind.belongs_to


def _taken(name: str, placement: Placement, present: Sequence[Effect]) -> bool:
    """Whether the model has an effect of this `name` in some of the moments."""
    acting = [one.acts_in for one in present if one.name == name]
    return any(placement is None or one is None or placement & one for one in acting)
