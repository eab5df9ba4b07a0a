"""The diagnosis: detect, propose, refit, decide, adapt, and judge on frames that no fit has seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from irlos_pipe.diagnose.acceptance import Accepted, Options, Search, choose, explained, no_longer_needed
from irlos_pipe.diagnose.checks.drift import Drift, measure_drift
from irlos_pipe.diagnose.checks.noise import PHOTONS, judge_all
from irlos_pipe.diagnose.checks.pixels import bad_pixel_family
from irlos_pipe.diagnose.conclude import conclude
from irlos_pipe.diagnose.cube import Cube
from irlos_pipe.diagnose.fitting import Fitted, Fitter
from irlos_pipe.diagnose.null_model import Optimum
from irlos_pipe.diagnose.refit import Refit, refits
from irlos_pipe.diagnose.search.scores import Score, families, scores
from irlos_pipe.diagnose.splitting import hold_out_of
from irlos_pipe.diagnose.verdict import Diagnosis
from irlos_pipe.diagnose.view import Exposures
from irlos_pipe.effects import CATALOGUE, Conditions, Effect

Report = Callable[[int], None]


def silent(count: int) -> None:
    """Report nothing."""


@torch.no_grad()
def diagnose(
    recordings: Sequence[Exposures],
    effects: Sequence[Effect],
    options: Options,
    *,
    device: str = "cpu",
    report: Report = silent,
) -> Diagnosis:
    """Find what the model of one recording lacks, or that of several taken with different settings.

    Parameters
    ----------
    recordings : sequence of Exposures
        With different focus, diversity or band, but the same window; of one wavefront. Effects are stated
        for the first.
    effects : sequence of Effect
        What the model has already.
    options : Options
    device : str
    report : callable, optional
        Called with the number of finished fits, for a progress bar.

    """
    began = time.perf_counter()
    hold_out = hold_out_of(recordings)
    cubes = [hold_out.split(one.frames, options.held_out) for one in recordings]
    noise = judge_all([part for cube in cubes for part in cube.training.parts])
    cube = Cube.of_all([one.limited_by(noise.kind == PHOTONS) for one in cubes])
    nolls = range(2, options.highest_noll + 1)
    views = [one.view(nolls, device) for one in recordings]
    task = Task(cube, Fitter(views, cube.training), recordings[0].conditions, options, report)
    search = task.searched(effects)
    diagnosis = conclude(task.cube, search, noise, options, recordings[0].screened)
    return replace(diagnosis, seconds=time.perf_counter() - began)


@dataclass(frozen=True)
class Task:
    """A cube with the means to fit it."""

    cube: Cube
    fitter: Fitter
    conditions: Conditions
    options: Options
    report: Report

    def searched(self, effects: Sequence[Effect]) -> Search:
        """Add names until nothing significant is missing, or nothing explains what is."""
        null = self._optimum(self._null(effects))
        drift, current = self._with_drift(null)
        accepted: list[Accepted] = []
        for _ in range(2 * self.options.most_names):  # names may be dropped again
            found, meaningless = self._scores(current)
            if len(accepted) == self.options.most_names:
                break
            chosen = self._next_name(current, found, first=not accepted)
            if chosen is None:
                break
            accepted.append(chosen)
            if self._leads_nowhere(chosen.refit):
                current = chosen.refit.optimum
                break
            current, accepted = self._adapted(accepted)
        return Search(null, current, drift, accepted, found, meaningless)

    # -- steps ---------------------------------------------------------------------------------

    def _null(self, effects: Sequence[Effect]) -> Fitted:
        """The fit without anything new, of it and its twins the most plausible.

        A changing wavefront has many false minima: the fit with it starts from that of a constant one.
        """
        constant = [effect for effect in effects if effect.plane != "time"]
        near = self._null(constant) if len(constant) < len(effects) else None
        found = [self.fitter.fit(effects, near)]
        found.append(self.fitter.twin(found[0]))
        if found[1].chi2 < found[0].chi2:  # a deeper minimum, which has a twin of its own
            found.append(self.fitter.twin(found[1]))
        self.report(2)
        return self.fitter.most_plausible(found)

    def _with_drift(self, null: Optimum) -> tuple[Drift | None, Optimum]:
        """The drift of the frames, and the model with it if it is significant."""
        known = any(effect.found_by == "frames" for effect in null.fitted.effects)
        if known or not self.cube.training.in_time:
            return None, null
        drift = measure_drift(self.cube.training, null.fitted, self.options.sure)
        if drift.significance < self.options.sure:
            return drift, null
        fitted = self.fitter.fit([*null.fitted.continued(), drift.effect()], null.fitted)
        return drift, self._optimum(fitted)

    def _scores(self, current: Optimum) -> tuple[list[Score], list[str]]:
        """Scores of all families that the model lacks."""
        present = current.fitted.effects
        missing, meaningless = families(self.conditions, [effect.name for effect in present])
        listed = any(effect.found_by == "pixels" for effect in present)
        pixels = [] if listed else bad_pixel_family(current)
        if not self.cube.training.in_time:
            meaningless += [name for name, kind in CATALOGUE.items() if kind.found_by == "frames"]
        return scores(current, [*missing, *pixels]), meaningless

    def _next_name(self, current: Optimum, found: list[Score], *, first: bool) -> Accepted | None:
        """The name to add next; None if nothing is missing or nothing explains it."""
        sure = self.options.sure
        suspicious = current.excess.significance > sure or any(s.significance > sure for s in found)
        if not suspicious:
            return None
        ranked = refits(self.fitter, current, found, self.report)
        return choose(ranked, self.cube, self.options, first=first)

    def _leads_nowhere(self, refit: Refit) -> bool:
        """Whether a name leaves much, and explains less than its share of as many names as are allowed."""
        much = refit.excess.significance > self.options.sure
        return much and explained(refit) < 1 / self.options.most_names

    def _adapted(self, accepted: list[Accepted]) -> tuple[Optimum, list[Accepted]]:
        """The model with the new name, without one that it makes superfluous."""
        current = accepted[-1].refit.optimum
        superfluous = no_longer_needed(self.fitter, current, accepted)
        if superfluous is None:
            return current, accepted
        one, without = superfluous
        return self._optimum(without), [other for other in accepted if other is not one]

    def _optimum(self, fitted: Fitted) -> Optimum:
        return Optimum(self.cube.training, fitted)
