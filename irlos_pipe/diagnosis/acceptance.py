"""Whether a name is accepted, also by frames or pixels that no fit has seen, and which others these allow.

What belongs to single frames, tip, tilt, flux and background, is refitted linearly to frames; all else is
frozen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from irlos_pipe.diagnosis.checks.drift import MOVING, Drift, motion_ratio
from irlos_pipe.diagnosis.cube import Cube, Stacks
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.null_model import Excess, Optimum, gaussian_sigma, threshold
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.records import Alternative, Gap, Ranked
from irlos_pipe.diagnosis.refit import CLEARLY_LESS, EXPLAINS_AS_MUCH, Refit
from irlos_pipe.diagnosis.scores import Score


class HeldOutEvaluation:
    """A model's residuals on the held-out data."""

    def __init__(self, stack: Stacks, fitted: Fitted):
        self.stack, self.pixels = stack, fitted.problem.pixels
        self.image, columns = fitted.linearised
        recordings = range(len(fitted.problem.parts) if stack.held_out == "frames" else 0)
        own = columns[[column for number in recordings for column in fitted.problem.own_of(number)]].mT
        root = stack.root[:, None]
        self.basis, triangle = torch.linalg.qr(own * root)
        self.moves = own @ torch.linalg.inv(triangle)

    @property
    def mean_e(self) -> torch.Tensor:
        """Prediction of the mean images, (pixels,)."""
        residual = (self.stack.mean_e - self.image) * self.stack.root
        return self.image + self.moves @ (self.basis.mT @ residual)

    @property
    def gap(self) -> float:
        good = self.stack.root > 0
        return float((self.stack.mean_e - self.mean_e)[good].abs().sum() / self.stack.mean_e[good].sum())

    @property
    def floor(self) -> float:
        """What noise alone leaves of the gap: a normal deviate is √(2/π) σ away from zero on average.

        What frames differ by in pointing, flux and background is no noise: it is refitted.
        """
        good = self.stack.root > 0
        noise_e = self.stack.noise_e(self.basis)[good].sum()
        return float(np.sqrt(2 / np.pi) * noise_e / self.stack.mean_e[good].sum())

    @property
    def losses(self) -> np.ndarray:
        """Half of χ² of every frame or patch of pixels, (frames or patches,)."""
        pairs = zip(self.stack.parts, self.pixels, strict=True)
        return np.concatenate([part.losses(self.image[at], self.basis[at]) for part, at in pairs])


def preference(stack: Stacks, better: Fitted, worse: Fitted) -> float:
    """Vuong's statistic for the model `better` on held-out data: mean difference of losses over its error."""
    difference = HeldOutEvaluation(stack, worse).losses - HeldOutEvaluation(stack, better).losses
    error = difference.std(ddof=1) / np.sqrt(stack.independent)
    return float(difference.mean() / error) if error > 0 else 0.0


def gap_between(stack: Stacks, before: Fitted, after: Fitted) -> Gap:
    """Gaps of the models `before` and `after` on the same held-out data."""
    old = HeldOutEvaluation(stack, before)
    return Gap(old.gap, HeldOutEvaluation(stack, after).gap, old.floor)


DECIDED = 3.0  # Vuong's statistic from which held-out data decide between two models
LIKENESS = 0.9  # |cos| from which two effects are degenerate in the image
LARGEST_SET = 3  # names not distinguished from the best that are listed, with it


def alternatives(ranked: Sequence[Refit], cube: Cube) -> list[Alternative]:
    """Names that are not significantly worse than the first of `ranked`, nor on held-out data of `cube`."""
    best, found = ranked[0], []
    for other in ranked[1:]:
        z = preference(cube.held_out, best.fitted, other.fitted)
        if best.deficit(other) < CLEARLY_LESS or (z < DECIDED and other.gain > EXPLAINS_AS_MUCH * best.gain):
            cosine = likeness(best.fitted, other.fitted, best.origin)
            alike = "they change the image alike" if cosine > LIKENESS else "both explain the excess as well"
            reason = f"{alike} (|cos| {cosine:.3f}), and the held-out frames do not decide (z {z:.1f})"
            found.append(Alternative(other.name, reason, best.base.look_alike, cosine))
    return sorted(found, key=lambda one: -one.likeness)[: LARGEST_SET - 1]


def likeness(one: Fitted, other: Fitted, before: Optimum) -> float:
    """|cos| of the changes of the image that models `one` and `other` make.

    They are projected off the fitted parameters of the model `before`.
    """
    gram = before.norm2(torch.stack([before.change_to(fitted) for fitted in (one, other)], dim=1))
    return float(gram[0, 1].abs() / (gram[0, 0] * gram[1, 1]).clamp_min(1e-300).sqrt())


SIGNIFICANT = 5.0  # standard errors of the excess, from which that of a moment counts


@dataclass(frozen=True)
class Accepted:
    """A name, and how it compared."""

    refit: Refit
    preference: float  # Vuong's statistic on the held-out frames, against the model before
    gap: Gap  # on the held-out frames, of the models without and with it
    alternatives: Sequence[Alternative]
    ranking: Sequence[Ranked]
    rivals: Sequence[Refit] = ()  # fits of the alternatives

    @property
    def name(self) -> str:
        return self.refit.name

    @property
    def label(self) -> str:
        """In the model with which a search ended."""
        return self.refit.label

    @property
    def ordinary(self) -> bool:
        """Whether as much of it is to be expected anywhere."""
        return self.refit.base.ordinary(self.refit.values)


@dataclass(frozen=True)
class Search:
    """What a search found."""

    null: Optimum  # before all names
    final: Optimum  # with all names
    drift: Drift | None  # None where the model has one already
    accepted: list[Accepted]  # names in the order found, the drift not among them
    scores: list[Score]  # of all families, at the last model for which a name was looked for
    meaningless: list[str]  # effects that mean nothing for this cube
    # Effects of the final model that make it fit better and are not sure enough to be named.
    adjusted: Sequence[str] = ()
    nearest: Accepted | None = None  # the name that comes nearest, where none was found after all
    # Whether the facts of the instrument were free, as more was wrong than single names could tell.
    tolerant: bool = False

    @cached_property
    def remaining(self) -> Excess:
        """What the final model leaves besides noise and the error of the flat, which shows by itself."""
        stack = self.final.stack.without_model_error().limited_by(self.null.stack.photon_limited)
        return self.final.under(stack).excess


def choose(ranked: Sequence[Refit], cube: Cube, options: Options) -> Accepted | None:
    """Choose the best of the fitted names, which are `ranked` with the best first, or None.

    It must be significant, and the held-out frames must agree.
    """
    if not ranked or not detected(ranked[0], cube, options.sure):
        return None
    for order in (by_motion, by_plausibility, by_simplicity):
        ranked = order(ranked, cube)
    best, stack = ranked[0], cube.held_out
    z = preference(stack, best.fitted, best.origin.fitted)
    if z < (DECIDED if cube.training.photon_limited else 0.0):
        return None
    of_each = [preference(stack, best.fitted, one.fitted) for one in ranked]
    ranking = [
        Ranked(one.name, one.gain, explained(one), one.significance, own_z)
        for one, own_z in zip(ranked, of_each, strict=True)
    ]
    others = alternatives(ranked, cube)
    rivals = [next(r for r in ranked if r.name == other.name) for other in others]
    gap = gap_between(stack, best.origin.fitted, best.fitted)
    return Accepted(best, z, gap, others, ranking, rivals)


def by_motion(ranked: Sequence[Refit], cube: Cube) -> Sequence[Refit]:
    """Decide by the motion of the frames between effects that blur, which a mean image hardly shows.

    This and the functions below return `ranked` in another order.
    """
    if cube.training.held_out == "pixels" or not ranked[0].effect.blurs:
        return ranked
    rivals = _rivals(ranked, cube)
    if not any(one.effect.blurs for one in rivals):
        return ranked
    right = "motion" if motion_ratio(cube.training, ranked[0].fitted) > MOVING else "detector"
    return _led_by([one for one in (ranked[0], *rivals) if one.effect.blurs == right], ranked)


def by_plausibility(ranked: Sequence[Refit], cube: Cube) -> Sequence[Refit]:
    """Among indistinguishable names prefer the first with plausible parameters."""
    if not ranked[0].implausible:
        return ranked
    return _led_by([one for one in _rivals(ranked, cube) if not one.implausible][:1], ranked)


def by_simplicity(ranked: Sequence[Refit], cube: Cube) -> Sequence[Refit]:
    """Prefer to an effect the one of which it is a wider form, if these data do not distinguish them."""
    narrower = ranked[0].base.widens
    return _led_by([one for one in _rivals(ranked, cube) if one.name == narrower], ranked)


def _rivals(ranked: Sequence[Refit], cube: Cube) -> list[Refit]:
    """Those that these data allow instead of the first, in their order."""
    names = {one.name for one in alternatives(ranked, cube)}
    return [one for one in ranked[1:] if one.name in names]


def _led_by(first: Sequence[Refit], ranked: Sequence[Refit]) -> list[Refit]:
    """All in another order: some `first`, the others as they were."""
    return [*first, *(one for one in ranked if one not in first)]


def detected(refit: Refit, cube: Cube, sure: float) -> bool:
    """Whether `refit` lowers χ² beyond chance and is significant, above `sure` σ.

    It is so in the training frames, all places of the search counted, or in those that no fit has seen: the
    scatter of few independent frames allows no strong statement about many places. The preference of the
    held-out frames is a deviate of Student's law.
    """
    if not refit.gain > threshold(refit.parameters, refit.score.trials) * refit.score.inflation:
        return False
    if refit.significance > sure:
        return True
    z = preference(cube.held_out, refit.fitted, refit.origin.fitted)
    return z > 0 and gaussian_sigma(z**2, 1, cube.held_out.independent) > sure


def explained(refit: Refit) -> float:
    """Part of the excess that a name explains, of several moments in that where it explains most."""
    moments = {view.moment for view in refit.fitted.views if refit.base.acting(view.moment)}
    pairs = [(refit.origin.excess_in(one), refit.optimum.excess_in(one)) for one in moments]
    if len(pairs) == 1:
        return (pairs[0][0] - pairs[0][1]) / max(pairs[0][0], refit.gain)
    significant = [one for one in pairs if one[0] > SIGNIFICANT * refit.origin.excess.sigma]
    return max(((before - after) / before for before, after in significant), default=0.0)
