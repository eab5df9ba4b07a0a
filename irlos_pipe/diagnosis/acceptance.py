"""Whether a fitted name is accepted."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from irlos_pipe.diagnosis.checks.drift import MOVING, Drift, motion_ratio
from irlos_pipe.diagnosis.cube import Cube
from irlos_pipe.diagnosis.held_out import HeldOutEvaluation, alternatives, gap_between, preference
from irlos_pipe.diagnosis.null_model import Excess, Optimum
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.records import Alternative, Gap, Ranked
from irlos_pipe.diagnosis.refit import Refit
from irlos_pipe.diagnosis.search.scores import Score
from irlos_pipe.diagnosis.significance import gaussian_sigma

SIGNIFICANT = 5.0  # standard errors of the excess, from which that of a moment counts
PREFERRED = 3.0  # Vuong's statistic on held-out frames, where noise is known


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
    evaluations = [HeldOutEvaluation(cube.held_out, refit.fitted) for refit in ranked]
    ranked, judges = by_simplicity(*by_plausibility(*by_motion(ranked, evaluations, cube)))
    best, without = ranked[0], HeldOutEvaluation(cube.held_out, ranked[0].origin.fitted)
    z = preference(judges[0], without)
    if z < (PREFERRED if cube.training.photon_limited else 0.0):
        return None
    ranking = [_ranked(one, preference(judges[0], judge)) for one, judge in zip(ranked, judges, strict=True)]
    others = alternatives(ranked, judges)
    rivals = [next(r for r in ranked if r.name == other.name) for other in others]
    return Accepted(best, z, gap_between(without, judges[0]), others, ranking, rivals)


def _ranked(refit: Refit, held_out_z: float) -> Ranked:
    return Ranked(refit.name, refit.gain, explained(refit), refit.significance, held_out_z)


def by_motion(
    ranked: Sequence[Refit], judges: Sequence[HeldOutEvaluation], cube: Cube
) -> tuple[Sequence[Refit], Sequence[HeldOutEvaluation]]:
    """Decide by the motion of the frames between effects that blur, which a mean image hardly shows.

    This and the functions below return `ranked` in another order, and `judges`, the evaluation of each, with
    it.
    """
    if not cube.training.in_time:
        return ranked, judges
    rivals = _rivals(ranked, judges)
    if not ranked[0].effect.blurs or not any(one.effect.blurs and one.name in rivals for one in ranked):
        return ranked, judges
    right = "motion" if motion_ratio(cube.training, ranked[0].fitted) > MOVING else "detector"
    allowed = [
        i for i, one in enumerate(ranked) if one.effect.blurs == right and (i == 0 or one.name in rivals)
    ]
    return _led_by(allowed, ranked, judges)


def by_plausibility(
    ranked: Sequence[Refit], judges: Sequence[HeldOutEvaluation]
) -> tuple[Sequence[Refit], Sequence[HeldOutEvaluation]]:
    """Among indistinguishable names prefer the first with plausible parameters."""
    if not ranked[0].implausible:
        return ranked, judges
    rivals = _rivals(ranked, judges)
    better = [i for i, one in enumerate(ranked) if one.name in rivals and not one.implausible]
    return _led_by(better[:1], ranked, judges)


def by_simplicity(
    ranked: Sequence[Refit], judges: Sequence[HeldOutEvaluation]
) -> tuple[Sequence[Refit], Sequence[HeldOutEvaluation]]:
    """Prefer to an effect the one of which it is a wider form, if these data do not distinguish them."""
    rivals = _rivals(ranked, judges)
    narrower = [i for i, one in enumerate(ranked) if one.name == ranked[0].base.widens and one.name in rivals]
    return _led_by(narrower, ranked, judges)


def _rivals(ranked: Sequence[Refit], judges: Sequence[HeldOutEvaluation]) -> set[str]:
    """Names that these data allow instead of the first."""
    return {one.name for one in alternatives(ranked, judges)}


def _led_by(
    first: Sequence[int], ranked: Sequence[Refit], judges: Sequence[HeldOutEvaluation]
) -> tuple[Sequence[Refit], Sequence[HeldOutEvaluation]]:
    """Both in another order: the positions `first` ahead, the others as they were."""
    order = [*first, *(i for i in range(len(ranked)) if i not in first)]
    return [ranked[i] for i in order], [judges[i] for i in order]


def detected(refit: Refit, cube: Cube, sure: float) -> bool:
    """Whether `refit` lowers χ² beyond chance and is significant, above `sure` σ.

    It is so in the training frames, all places of the search counted, or in those that no fit has seen: the
    scatter of few independent frames allows no strong statement about many places.
    """
    if not refit.beyond_chance:
        return False
    return refit.significance > sure or _held_out_significance(refit, cube) > sure


def _held_out_significance(refit: Refit, cube: Cube) -> float:
    """Preference of the held-out frames, a deviate of Student's law, in Gaussian σ."""
    judges = (HeldOutEvaluation(cube.held_out, one) for one in (refit.fitted, refit.origin.fitted))
    z = preference(*judges)
    return gaussian_sigma(z**2, 1, cube.held_out.independent) if z > 0 else 0.0


def explained(refit: Refit) -> float:
    """Part of the excess that a name explains, of several moments in that where it explains most."""
    moments = {view.moment for view in refit.fitted.views if refit.base.acting(view.moment)}
    pairs = [(refit.origin.excess_in(one), refit.optimum.excess_in(one)) for one in moments]
    if len(pairs) == 1:
        return (pairs[0][0] - pairs[0][1]) / max(pairs[0][0], refit.gain)
    significant = [one for one in pairs if one[0] > SIGNIFICANT * refit.origin.excess.sigma]
    return max(((before - after) / before for before, after in significant), default=0.0)
