"""Which families of effects the residual calls for: score tests at the optimum of the current model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.special import logsumexp

from irlos_pipe.diagnosis.null_model import FittedModel, significance_of
from irlos_pipe.diagnosis.view import Moments, Placement
from irlos_pipe.effects import CATALOGUE, Effect, FixedEffect
from irlos_pipe.estimate.score_test import (
    ABSORBED,
    RESOLVED,
    LinearEstimate,
    brightest_copies,
    derivatives,
)
from irlos_pipe.numerics.parallel import ordered_map

BUNDLED = 32  # candidates in the pupil or of the OTF that share one light path
LINEAR = 0.5  # of the prior's σ: how far from null a fit begins at most, where the estimate is linear
CLEARLY_MORE = 25.0  # calibrated χ² that one moment alone must gain beyond all moments jointly
FAR_APART = 0.2  # distance over the range searched, from which another candidate is elsewhere


@dataclass(frozen=True)
class Family:
    """One effect that may be missing."""

    variants: tuple[Effect, ...]  # shapes of the same effect
    positions: int = 1  # where the effect was looked for before, of which these are the best
    # Of recordings of several moments, those in which the effect may act alone; None: in all.
    placements: Sequence[Placement] = (None,)

    @property
    def effect(self) -> Effect:
        """The first of the variants."""
        return self.variants[0]


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


@dataclass(frozen=True, eq=False)
class Score:
    """What one candidate would do at the optimum without it."""

    candidate: Effect  # its free parameters at their null values
    sizes: np.ndarray  # (parameters,), linear estimate of the free parameters, within their bounds
    gain: float  # predicted fall of χ²
    inflation: float  # fall of χ² per parameter that the scatter of frames leads to expect without the effect
    # Part of the derivative's power that the fitted parameters cannot imitate, 1 − R², of the best parameter.
    observability: float
    significance: float  # in Gaussian σ, candidates of the family counted as trials
    # (parameters,), size of each parameter whose expected gain is one times the inflation, median over the
    # candidates.
    smallest: np.ndarray
    usable: tuple[str, ...] = ()  # parameters that these data determine
    trials: int = 1  # candidates of the family
    besides: "tuple[Score, ...]" = ()  # best candidates with other parameters of the same effect
    elsewhere: "tuple[Score, ...]" = ()  # the best candidate far from this one, if there is any
    # ln odds of the effect against its absence, of several places that of all together, by proper priors
    log_odds: float = -np.inf

    @property
    def name(self) -> str:
        return self.candidate.name

    @property
    def testable(self) -> bool:
        """Whether these data can show the effect."""
        return self.observability > ABSORBED

    def start(self, within: float = LINEAR) -> FixedEffect:
        """The whole effect, free but for what these data do not determine, at the linear estimate.

        A phase of a radian is no longer linear: whatever has a prior starts `within` some σ of it.
        """
        null = np.array(self.candidate.null_values)
        reach = within * np.array([p.prior_sigma for p in self.candidate.parameters])
        base = self.candidate.base
        values = self.candidate.all_values(np.clip(self.sizes, null - reach, null + reach))
        unseen = {p.name for p in self.candidate.parameters} - {*self.usable}
        return FixedEffect(base, values, [p.name for p in base.parameters if p.name not in unseen])

    def whole(self, within: float = LINEAR) -> FixedEffect:
        """The effect to be fitted, which may have more parameters than the one that was searched for."""
        start = self.start(within)
        return start.base.whole(start, self.sizes).only_in(self.candidate.acts_in)


def scores(optimum: FittedModel, families: Sequence[Family]) -> list[Score]:
    """Score the best candidate of each of the `families` at an `optimum`, the most significant first.

    Of families of one name, for different moments, the best stands.
    """
    found = ordered_map(partial(score_family, optimum), families)
    names = dict.fromkeys(one.name for one in found)
    best = [_best_placed([one for one in found if one.name == name]) for name in names]
    return sorted(best, key=lambda one: -one.significance)


def score_family(optimum: FittedModel, family: Family) -> Score:
    """Score the best candidate of one `family` at an `optimum`; its other candidates count as trials."""
    settings = optimum.settings
    tried = [
        candidate
        for effect in family.variants
        for candidate in effect.candidates(settings.window, settings.pixel_scale_mas)
    ]
    trials = len(tried) * family.positions * len(family.placements)
    if family.effect.copies_star:
        tried = [*copies_in(optimum, family.effect), *around(family.effect)]
    bundled = family.effect.plane in ("pupil", "otf") and not family.effect.copies_star
    size = BUNDLED if bundled else 1  # candidates whose derivatives are computed in one go
    bundles = [tried[i : i + size] for i in range(0, len(tried), size)]
    pieces = ordered_map(partial(scored, optimum, trials, family.placements), bundles)
    found = [score for piece in pieces for score in piece]
    alike = ([one for one in found if one.candidate.acts_in == where] for where in family.placements)
    return _best_placed([_best_of(some) for some in alike])


def _best_of(found: Sequence[Score]) -> Score:
    """The best of the candidates of one family, with the others that a fit may need."""
    kinds = {one.usable: _typical([o for o in found if o.usable == one.usable]) for one in found}
    best = max(kinds.values(), key=lambda one: one.gain)
    besides = tuple(one for one in kinds.values() if one is not best and one.usable)
    together = float(logsumexp([one.log_odds for one in found])) - np.log(best.trials)
    return replace(best, besides=besides, elsewhere=_elsewhere(best, found), log_odds=together)


def _best_placed(alike: Sequence[Score]) -> Score:
    """Of scores of one effect the best; one moment alone only where it gains clearly more than all."""
    best = max(alike, key=lambda one: one.gain / one.inflation)
    common = next((one for one in alike if one.candidate.acts_in is None), best)
    return common if best.gain - common.gain < CLEARLY_MORE * common.inflation else best


def _typical(alike: Sequence[Score]) -> Score:
    """The best of candidates with the same parameters, with sizes that are typical of them all."""
    smallest = np.median([one.smallest for one in alike], axis=0)
    return replace(max(alike, key=lambda one: one.gain), smallest=smallest)


def _elsewhere(best: Score, found: Sequence[Score]) -> tuple[Score, ...]:
    """The best candidate that differs from `best` by much of the range searched, if there is one."""
    alike = [one for one in found if one.usable == best.usable]
    tried = np.array([_null_of(one) for one in alike])
    unit = np.ptp(tried, axis=0)
    positions = (tried - _null_of(best)) / np.where(unit > 0, unit, 1.0)
    far = np.abs(positions).max(axis=1, initial=0.0) > FAR_APART
    others = [one for one, apart in zip(alike, far, strict=True) if apart and one.gain > 0]
    return tuple(sorted(others, key=lambda one: -one.gain)[:1])


def _null_of(score: Score) -> np.ndarray:
    """All parameters of a candidate, the free ones at null."""
    return score.candidate.all_values(score.candidate.null_values).numpy()


def whitened_shapes(optimum: FittedModel, candidates: Sequence[Effect]) -> list[torch.Tensor]:
    """Derivatives of the mean images with respect to each candidate's parameters at null, (pixels, m) each.

    Several candidates must be of one plane, pupil or OTF.
    """
    fitted, columns, sizes = optimum.fitted, [], [len(one.parameters) for one in candidates]
    for view, (part, x), frozen in zip(fitted.views, fitted.recordings, optimum.frozen, strict=True):
        seen = view.seen(candidates, fitted.views)
        if seen:
            columns.append(derivatives(part, x, frozen, seen[0] if len(seen) == 1 else _Bundle(seen)))
        else:  # the candidates do not act there
            columns.append(torch.zeros(sum(sizes), part.images.shape[-1], dtype=torch.float64))
    return list(optimum.whiten(torch.cat(columns, dim=1).mT).split(sizes, dim=1))


def scored(
    optimum: FittedModel, trials: int, placements: Sequence[Placement], candidates: Sequence[Effect]
) -> list[Score]:
    """Scores of every candidate, in every placement that all the recordings of the `candidates` hold."""
    found, shapes = [], whitened_shapes(optimum, candidates)
    for where in placements:
        seen = [_seen_in(optimum, where, one) for one in shapes]
        inside = optimum.basis.mT @ torch.cat(seen, dim=1)  # at once: the basis is long
        rows = zip(candidates, seen, inside.split([one.shape[1] for one in seen], dim=1), strict=True)
        found += [_score(optimum, trials, one.only_in(where), *shape) for one, *shape in rows]
    return found


def _seen_in(optimum: FittedModel, where: Placement, shapes: torch.Tensor) -> torch.Tensor:
    """What recordings of some moments show of whitened shapes (pixels, m)."""
    if where is None:
        return shapes
    seen, fitted = torch.zeros_like(shapes), optimum.fitted
    for view, pixels in zip(fitted.views, fitted.problem.pixels, strict=True):
        if view.moment in where:
            seen[pixels] = shapes[pixels]
    return seen


def _score(optimum: FittedModel, trials: int, candidate: Effect, *shapes: torch.Tensor) -> Score:
    linear = LinearEstimate.of(optimum, candidate, *shapes)
    inflation, significance = 1.0, 0.0
    if linear.usable.any():
        inflation, significance = significance_of(optimum, linear, trials)
    smallest = (inflation / linear.left.clamp_min(1e-300)).sqrt()
    return Score(
        candidate,
        linear.sizes,
        linear.gain,
        inflation,
        linear.observability,
        significance if linear.gain > 0 else 0.0,
        torch.where(linear.usable, smallest, torch.inf).numpy(),
        tuple(p.name for p, use in zip(candidate.parameters, linear.usable.tolist(), strict=True) if use),
        trials,
        log_odds=_log_odds(linear, inflation),
    )


def _log_odds(linear: LinearEstimate, inflation: float) -> float:
    """ln odds of a candidate against its absence, its size integrated out, variances times `inflation`."""
    if not linear.usable.any():
        return -np.inf
    pairs = zip(linear.candidate.parameters, linear.usable.tolist(), strict=True)
    sigma = torch.tensor([one.proper_prior[1] for one, used in pairs if used], dtype=torch.float64)
    gram, force = linear.gram / max(1.0, inflation), linear.projection / max(1.0, inflation)
    size = torch.linalg.solve(gram + torch.diag(sigma**-2), force)
    spread = torch.eye(len(sigma), dtype=torch.float64) + sigma[:, None] * gram * sigma
    volume = torch.linalg.slogdet(spread)[1]
    return 0.5 * float(force @ size - volume)


class _Bundle(Effect):
    """Several candidates of one plane as one effect, at their null values, where light passes unchanged.

    The light path up to them is computed once for all.
    """

    name = "bundle"

    def __init__(self, candidates: Sequence[Effect]):
        self.bundled = tuple(candidates)
        self.plane, self.order = candidates[0].plane, candidates[0].order
        self.parameters = tuple(p for one in candidates for p in one.parameters)

    @property
    def null_values(self) -> list[float]:
        return [value for one in self.bundled for value in one.null_values]

    def apply(self, values: torch.Tensor, *light: torch.Tensor, **more: Any) -> torch.Tensor:
        return light[0]

    def slopes(
        self, values: torch.Tensor, light: torch.Tensor, grid: Any, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        every: list[torch.Tensor] = []
        for one in self.bundled:
            null = torch.tensor(one.null_values, dtype=torch.float64)
            every += one.slopes(null, light, grid, range(len(null)))
        return [every[index] for index in wanted]


RING_MAS, DIRECTIONS = 150.0, 8  # a ring of positions that say how faint a copy can be seen
# Rings about the core, where modes imitate copies, and how far positions along them are apart [λ/D].
CLOSE, SPACED = (0.8, 1.2, 1.7, 2.4), 0.6


def copies_in(optimum: FittedModel, effect: Effect) -> list[FixedEffect]:
    """The most promising positions of `effect`, a copy of the star, which need not be in all recordings."""
    window, fitted = optimum.settings.window, optimum.fitted
    backgrounds = torch.cat([x[0, -1:].expand(window[0] * window[1]) for _, x in fitted.recordings])
    stars = (fitted.image_e - backgrounds).reshape(-1, *window)
    acting = [float(effect.acting(view.moment)) for view in fitted.views]
    stars = stars * torch.tensor(acting, dtype=torch.float64)[:, None, None]
    return brightest_copies(optimum, stars, optimum.settings, effect, _copies(optimum, effect))


def _copies(optimum: FittedModel, wanted: Effect) -> list[tuple[float, float]]:
    """Positions of the copies of the star that the model has where the `wanted` one would act [mas]."""
    fitted, found = optimum.fitted, []
    moments = [view.moment for view in fitted.views if wanted.acting(view.moment)]
    for effect, label in zip(fitted.effects, fitted.problem.effects.labels, strict=True):
        if effect.copies_star and any(effect.acting(moment) for moment in moments):
            _, x_mas, y_mas, *_ = fitted.values_of(label)
            found.append((x_mas, y_mas))
    return found


def around(effect: Effect) -> list[FixedEffect]:
    """Positions of `effect` on all sides, which say how faint a copy of the star can be seen there."""
    return [effect.displaced(x, y) for x, y in _ring(RING_MAS, DIRECTIONS)]


def close_copies(optimum: FittedModel, effect: Effect) -> list[FixedEffect]:
    """Positions of `effect` about the core, where modes imitate most of a copy and little of it is left.

    Those not resolved from a copy that the model has are left out.
    """
    resolution_mas, known = optimum.settings.resolution_mas, _copies(optimum, effect)
    places = [
        place for ring in CLOSE for place in _ring(ring * resolution_mas, round(2 * np.pi * ring / SPACED))
    ]
    apart = RESOLVED * resolution_mas
    return [
        effect.displaced(x, y) for x, y in places if all(np.hypot(x - a, y - b) > apart for a, b in known)
    ]


def _ring(radius: float, number: int) -> list[tuple[float, float]]:
    """Points (x, y) of a circle."""
    angles = np.arange(number) * 2 * np.pi / number
    return [(radius * np.cos(angle), radius * np.sin(angle)) for angle in angles]
