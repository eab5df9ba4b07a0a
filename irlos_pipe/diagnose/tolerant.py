"""The search where nothing is exactly as told: facts of the instrument free, errors of the model allowed.

At a telescope the pupil, the scale, the band and the wavefront all differ a little from what a profile
states, and there is a little of every mild effect. One name after the other then explains little, and every
one of them stands in for the others. Here facts and mild effects are fitted together, the wavefront is taken
as far as the window sees it, and what the model still misses enters the variances, so that no name is earned
by what everything misses. What has a place is looked for beside all that. Last, effects that are not needed
are taken out, and the others are named if held-out frames want them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.units import resolution_px
from irlos_pipe.diagnose.acceptance import PREFERRED, Accepted, Search, accepted
from irlos_pipe.diagnose.checks.fine_structure import flat_rms
from irlos_pipe.diagnose.checks.noise import PHOTONS
from irlos_pipe.diagnose.cube import Errors, Stacks
from irlos_pipe.diagnose.effect_sizes import parameter_covariance
from irlos_pipe.diagnose.elimination import needed
from irlos_pipe.diagnose.fitting import Fitted
from irlos_pipe.diagnose.forward import Task
from irlos_pipe.diagnose.grade import AT_ITS_PLACE, share_at_its_place
from irlos_pipe.diagnose.null_model import Optimum
from irlos_pipe.diagnose.refit import Refit, quick_refits
from irlos_pipe.diagnose.search.scores import Family, Score, score_family
from irlos_pipe.diagnose.significance import gaussian_sigma
from irlos_pipe.effects import CATALOGUE, Conditions, Effect
from irlos_pipe.estimate.open_fit import Opened, open_basis
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.zernike import noll_to_nm

STARTS, START_NM = 2, 60.0  # further wavefronts to begin with: RMS of the first radial order, falling
KNOWN = 1.2  # χ²/ν up to which photons still set the errors
PROPOSALS = 6  # fitted per name
HARDLY_SEEN = 3.0  # significance of a score from which it is fitted


@dataclass(frozen=True)
class TolerantTask(Task):
    """A search with the facts of the instrument free, beside what the model has.

    Attributes
    ----------
    kind : str
        Of the noise.
    """

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
        free = everyday(self.conditions, model)
        task, current = self._with_errors(self._base([*model, *free], search))
        task, current, names = task._named(current, [])
        task, current = task._opened(current)
        task, current, names = task._named(current, names)
        task, current = task._with_errors(task._without_needless(current, [one.name for one in free]))
        task, current, names = task._named(current, names)
        confirmed = task._confirmed(current, [effect.name for effect in free])
        finished = task.fitter.finished(current.fitted)
        if np.isfinite(finished.chi2):
            current = Optimum(task.cube.training, finished)
        found, meaningless = task._scores(current)
        ranked = sorted([*names, *confirmed], key=lambda one: (one.ordinary, -one.refit.gain))
        named = {one.name for one in ranked}
        adjusted = [one.name for one in free if one.name not in named]
        return Search(search.null, current, drift, ranked, found, meaningless, adjusted)

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
        task = self._allowing(search.final.fitted)
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
        nolls, modes = near.problem.layout.nolls, near.problem.layout.modes
        falling = [START_NM * min(1.0, 2.0 / noll_to_nm(noll)[0]) ** 1.5 for noll in nolls]
        size = torch.tensor(falling, dtype=torch.float64)
        size[:2] = 0.0
        pointing = near.x[0, modes] * (size == 0)
        found = []
        for number in range(STARTS):
            drawn = torch.randn(len(nolls), generator=generator, dtype=torch.float64) * size
            x = near.x.clone()
            x[0, modes] = pointing + (drawn if number else 0.0)
            found.append(replace(near, solution=replace(near.solution, values=x)))
        return found

    def _with_errors(self, fitted: Fitted) -> tuple[TolerantTask, Optimum]:
        """The search that allows for what a model misses, and the model fitted again under it."""
        task = self._allowing(fitted)
        again = task.fitter.explored(fitted.continued(), fitted)
        fitted = again if np.isfinite(again.chi2) else fitted
        task = task._allowing(fitted)
        self.report(1)
        return task, Optimum(task.cube.training, task.fitter.at(fitted))

    def _allowing(self, fitted: Fitted) -> TolerantTask:
        """The same search beside variances that allow for what a model misses."""
        errors = errors_of(self.cube.training, fitted, self.conditions.settings)
        known = self.kind == PHOTONS and errors.misfit < KNOWN
        cube = self.cube.with_errors(errors).limited_by(known)
        return replace(self, cube=cube, fitter=self.fitter.of(cube.training))

    def _opened(self, current: Optimum) -> tuple[TolerantTask, Optimum]:
        """The search, and its model, with the wavefront beyond the fitted modes as all visible modes have it.

        One fit of all modes finds it; from there on it is known, which keeps every further fit as quick as
        before. Several recordings keep the modes that they have.
        """
        fitted = current.fitted
        opened = _opened_fit(fitted)
        if opened is None:
            return self, current
        nolls, values, closed = (
            opened.problem.layout.nolls,
            opened.solution.values,
            fitted.problem.layout.modes,
        )
        beyond = slice(closed.stop, len(nolls))
        tail_nm = dict(zip(nolls[beyond], values[0, beyond].tolist(), strict=True))
        views = [view.with_known(tail_nm) for view in self.fitter.views]
        x = torch.cat([values[:, closed], values[:, len(nolls) :]], dim=1)
        task = replace(self, fitter=self.fitter.of(self.cube.training, views))
        start = replace(fitted, solution=replace(fitted.solution, values=x), views=views)
        return task._with_errors(task.fitter.at(start))

    def _without_needless(self, current: Optimum, names: Sequence[str]) -> Fitted:
        """The model without those of its mild effects that are not significant beside the others."""
        fitted = current.fitted
        columns = {name: _testable_columns(fitted, name) for name in names}
        zero = np.zeros(fitted.problem.size)
        for name in names:
            own = fitted.columns_of(name)
            zero[own] = [
                0.0 if null is None else null for null in (p.null for p in fitted.effect(name).parameters)
            ]
        errors = errors_of(self.cube.training, fitted, self.conditions.settings)
        alone = self.cube.training.with_errors(replace(errors, alike_px=1.0))  # to keep rather than to drop
        covariance = parameter_covariance(alone, fitted)
        frames = np.inf if current.stack.photon_limited else current.stack.independent
        kept = needed(
            columns,
            fitted.x[0].numpy() - zero,
            covariance,
            lambda rise, count: gaussian_sigma(max(rise, 0.0), count, frames),
            self.options.sure,
        )
        effects = [effect for effect in fitted.continued() if effect.name in kept or effect.name not in names]
        return self.fitter.explored(effects, fitted)

    def _further(self, current: Optimum, found: list[Score]) -> Accepted | None:
        """The next name: significant, plausible, and wanted by the held-out frames."""
        places = [other for score in found if score.candidate.copies_star for other in score.elsewhere]
        seen = [one for one in (*found, *places) if one.significance > HARDLY_SEEN]
        ranked = quick_refits(
            self.fitter, current, sorted(seen, key=lambda one: -one.significance)[:PROPOSALS]
        )
        self.report(len(ranked))
        ranked = [one for one in ranked if not one.implausible and self._explains_its_own(one)]
        return self._wanted(ranked)

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

    def _confirmed(self, current: Optimum, names: Sequence[str]) -> list[Accepted]:
        """Effects without which the model fits significantly worse, also the held-out frames."""
        found = []
        for name in (one for one in names if one in [effect.name for effect in current.fitted.effects]):
            kept = [effect for effect in current.fitted.continued() if effect.name != name]
            without = self.fitter.explored(kept, current.fitted)
            if not np.isfinite(without.chi2):
                continue
            origin = Optimum(self.cube.training, without)
            family = Family(CATALOGUE[name].variants(self.conditions))
            refit = Refit(score_family(origin, family), origin, current.fitted)
            one = self._wanted([refit]) if self._explains_its_own(refit) else None
            if one is not None:
                found.append(one)
        return found


def _opened_fit(fitted: Fitted) -> Opened | None:
    """A fit of all visible modes; None of several recordings, or where it cannot be made."""
    if len(fitted.views) > 1:
        return None
    try:
        opened = open_basis(fitted.problem.parts[0], fitted.solution)
    except (ValueError, np.linalg.LinAlgError):
        return None
    return opened if opened and bool(opened.solution.values.isfinite().all()) else None


def everyday(conditions: Conditions, present: Sequence[Effect]) -> list[Effect]:
    """Facts of the instrument and mild effects, their values free.

    Parameters
    ----------
    conditions : Conditions
    present : sequence of Effect
        What a model has already.
    """
    model, found = {effect.name for effect in present}, []
    for name, kind in CATALOGUE.items():
        if not (kind.fact or kind.mild) or name in model:
            continue
        try:
            found.append(kind.under(conditions))
        except ValueError:
            continue  # it means nothing for this instrument
    return found


def _testable_columns(fitted: Fitted, name: str) -> list[int]:
    """Columns of those parameters of an effect that have a value without effect."""
    pairs = zip(fitted.columns_of(name), fitted.effect(name).parameters, strict=True)
    return [column for column, parameter in pairs if parameter.null is not None]


def errors_of(stack: Stacks, fitted: Fitted, settings: PsfSettings) -> Errors:
    """What flat and model miss, with which in the variances χ²/ν is one.

    Parameters
    ----------
    stack : Stacks
    fitted : Fitted
    settings : PsfSettings
        Of the first recording.
    """
    residual_e = stack.mean_e - fitted.image_e
    pairs = zip(stack.parts, fitted.problem.pixels, strict=True)
    flat = max(flat_rms(part, residual_e[pixels], settings) for part, pixels in pairs)
    across_px = resolution_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)
    errors = Errors(alike_px=max(1.0, np.pi / 4 * across_px**2), flat_rms=flat)
    white = residual_e * stack.with_errors(errors).root
    return replace(errors, misfit=max(1.0, float(white @ white) / fitted.problem.freedom))
