"""The search where nothing is exactly as told: facts of the instrument free, errors of the model allowed.

At a telescope the pupil, the scale, the band and the wavefront all differ a little from what a profile
states. One name after the other then explains little, and every one of them stands in for the others. Here
the facts are fitted together, the wavefront is taken as far as the window sees it, and what the model still
misses enters the variance as a part of the light, so that no name is earned by what everything misses. More
names are looked for beside all that; last, every fact is tried as it was told, and those that the data
contradict are named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.units import MAS, resolution_px
from irlos_pipe.diagnose.acceptance import Accepted, Search, accepted, detected
from irlos_pipe.diagnose.checks.noise import PHOTONS
from irlos_pipe.diagnose.cube import Stacks
from irlos_pipe.diagnose.fitting import Fitted, Fitter
from irlos_pipe.diagnose.forward import Task
from irlos_pipe.diagnose.grade import AT_ITS_PLACE, share_at_its_place
from irlos_pipe.diagnose.null_model import Optimum
from irlos_pipe.diagnose.refit import Refit, quick_refits
from irlos_pipe.diagnose.search.scores import Family, Score, score_family
from irlos_pipe.effects import CATALOGUE, Conditions, Effect
from irlos_pipe.optics.psf_settings import PsfSettings

STARTS, START_NM = 2, 60.0  # further wavefronts to begin with: RMS of the first radial order, falling
HIGHEST_ORDER = 18  # radial order at which an open wavefront ends for the sake of time
KNOWN = 1.2  # χ²/ν up to which photons still set the errors
PROPOSALS = 6  # fitted per name
HARDLY_SEEN = 3.0  # significance of a score from which it is fitted


@dataclass(frozen=True)
class TolerantTask(Task):
    """A search with the facts of the instrument free, beside what the model has.

    Attributes
    ----------
    wide : Fitter
        With as many modes as the window sees.
    kind : str
        Of the noise.
    """

    wide: Fitter
    kind: str

    def beyond(self, search: Search, effects: Sequence[Effect]) -> Search:
        """Begin again where a plain search left much: facts first, then names.

        The wavefront is opened last: many modes imitate whatever is small and bright.

        Parameters
        ----------
        search : Search
            What was found, and what is left.
        effects : sequence of Effect
            From which it began.
        """
        drift = search.drift
        moving = [drift.effect()] if drift and drift.significance > self.options.sure else []
        model = [*effects, *moving]
        free = facts(self.conditions, model)
        task, current = self._with_errors(self._base([*model, *free], search))
        task, current, names = task._named(current, [])
        task, current = replace(task, fitter=task.wide)._with_errors(current.fitted)
        task, current, names = task._named(current, names)
        contradicted, current = task._contradicted(current, [effect.name for effect in free])
        finished = task.fitter.finished(current.fitted)
        if np.isfinite(finished.chi2):
            current = Optimum(task.cube.training, finished)
        found, meaningless = task._scores(current)
        return Search(search.null, current, drift, [*names, *contradicted], found, meaningless)

    def _named(self, current: Optimum, names: list[Accepted]) -> tuple[TolerantTask, Optimum, list[Accepted]]:
        """Further names beside those found, the search that allows for what they leave, and its model."""
        task = self
        while len(names) < self.options.most_names:
            found, _ = task._scores(current)
            chosen = task._further(current, found)
            if chosen is None:
                break
            names = [*names, chosen]
            task, current = task._with_errors(chosen.refit.fitted)
        return task, current, names

    # -- steps ---------------------------------------------------------------------------------

    def _base(self, effects: Sequence[Effect], search: Search) -> Fitted:
        """The fit with all facts free, of several starts the most plausible."""
        task = self._allowing(misfit(self.cube.training, search.final.fitted))
        near = search.final.fitted
        found = [
            task.fitter.explored(effects, near),
            *(task.fitter.explored(effects, one) for one in self._starts(near)),
        ]
        self.report(len(found))
        good = [one for one in found if np.isfinite(one.chi2)]
        return task.fitter.most_plausible(good) if good else near

    def _starts(self, near: Fitted) -> list[Fitted]:
        """`near` with other wavefronts: none, and some at random, less in every radial order."""
        generator = torch.Generator().manual_seed(STARTS)
        nolls = near.problem.layout.nolls
        size = torch.tensor(
            [START_NM * min(1.0, 2.0 / radial_order(n)) ** 1.5 for n in nolls], dtype=torch.float64
        )
        size[:2] = 0.0
        found = []
        for number in range(STARTS):
            x = near.x.clone()
            drawn = torch.randn(len(nolls), generator=generator, dtype=torch.float64) * size
            x[0, near.problem.layout.modes] = (drawn if number else torch.zeros_like(drawn)) + x[
                0, near.problem.layout.modes
            ] * (size == 0)
            found.append(replace(near, solution=replace(near.solution, values=x)))
        return found

    def _with_errors(self, fitted: Fitted) -> tuple[TolerantTask, Optimum]:
        """The search that allows for what a model misses, and the model fitted again under it."""
        task = self._allowing(misfit(self.cube.training, fitted))
        again = task.fitter.explored(fitted.continued(), fitted)
        fitted = again if np.isfinite(again.chi2) else fitted
        task = task._allowing(misfit(self.cube.training, fitted))
        self.report(1)
        return task, Optimum(task.cube.training, task.fitter.at(fitted))

    def _allowing(self, factor: float) -> TolerantTask:
        """The same search beside variances `factor` times as large."""
        settings = self.conditions.settings
        across_px = resolution_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)
        alike_px = max(1.0, np.pi / 4 * across_px**2)
        cube = self.cube.with_model_error(factor, alike_px).limited_by(
            self.kind == PHOTONS and factor < KNOWN
        )
        fitter, wide = (Fitter(one.views, cube.training) for one in (self.fitter, self.wide))
        return replace(self, cube=cube, fitter=fitter, wide=wide)

    def _further(self, current: Optimum, found: list[Score]) -> Accepted | None:
        """The next name: significant, plausible, and wanted by the held-out frames."""
        places = [other for score in found if score.candidate.copies_star for other in score.elsewhere]
        seen = [one for one in (*found, *places) if one.significance > HARDLY_SEEN]
        ranked = quick_refits(
            self.fitter, current, sorted(seen, key=lambda one: -one.significance)[:PROPOSALS]
        )
        self.report(len(ranked))
        ranked = [one for one in ranked if not one.implausible and self._explains_its_own(one)]
        return accepted(ranked, self.cube, self.options)

    def _explains_its_own(self, refit: Refit) -> bool:
        """Whether a name leaves little where it acts; one that leaves much stands in for something else."""
        share = share_at_its_place(refit, refit.optimum, self.cube.training.with_model_error(1.0))
        return share > AT_ITS_PLACE[self.kind]

    def _contradicted(self, current: Optimum, names: Sequence[str]) -> tuple[list[Accepted], Optimum]:
        """Facts that the data contradict, the most significant first, and the model without the others."""
        found = []
        for name in names:
            kept = [effect for effect in current.fitted.continued() if effect.name != name]
            without = self.fitter.explored(kept, current.fitted)
            if not np.isfinite(without.chi2):
                continue
            origin = Optimum(self.cube.training, without)
            family = Family(CATALOGUE[name].variants(self.conditions))
            refit = Refit(score_family(origin, family), origin, current.fitted)
            one = accepted([refit], self.cube, self.options) if detected(refit, self.options.sure) else None
            if one is None:
                current = origin
            else:
                found.append(one)
        return sorted(found, key=lambda one: -one.refit.significance), current


def facts(conditions: Conditions, present: Sequence[Effect]) -> list[Effect]:
    """Facts of the instrument as effects with free values.

    Parameters
    ----------
    conditions : Conditions
    present : sequence of Effect
        What a model has already.
    """
    model, found = {effect.name for effect in present}, []
    for name, kind in CATALOGUE.items():
        if not kind.fact or name in model:
            continue
        try:
            found.append(kind.under(conditions))
        except ValueError:
            continue  # it means nothing for this instrument
    return found


def open_noll(settings: PsfSettings, least: int) -> int:
    """Highest Noll index whose light falls into the window, not below `least`.

    A mode of radial order n sends its light to (n + 1)/π λ/D (Noll 1976, JOSA 66, 207: its transform is a
    Bessel function of order n + 1); the window reaches to half its width.

    Parameters
    ----------
    settings : PsfSettings
    least : int
    """
    reach_rad = max(settings.window) / 2 * settings.pixel_scale_mas * MAS
    order = int(np.pi / 2 * reach_rad * settings.geometry.diameter_m / settings.shortest_m)
    order = min(order, HIGHEST_ORDER)
    return max(least, (order + 1) * (order + 2) // 2)


def radial_order(noll: int) -> int:
    """Radial order of the Zernike mode with a `noll` index."""
    return int((np.sqrt(8 * noll - 7) - 1) / 2)


def misfit(stack: Stacks, fitted: Fitted) -> float:
    """χ²/ν of a model beside plain variances, 1 where it fits as well as noise allows.

    Parameters
    ----------
    stack : Stacks
    fitted : Fitted
    """
    residual = (stack.mean_e - fitted.image_e) * stack.with_model_error(1.0).root
    return max(1.0, float(residual @ residual) / fitted.problem.freedom)
