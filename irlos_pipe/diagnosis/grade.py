"""How complete a diagnosis is: whether much is left, where it lies, and what that says of the names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from irlos_pipe.diagnosis.acceptance import Search
from irlos_pipe.diagnosis.checks.fine_structure import FineStructure
from irlos_pipe.diagnosis.checks.noise import PHOTONS, SPECKLES, UNSEEN, NoiseVerdict
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.refit import Refit
from irlos_pipe.diagnosis.verdict import COMPLETE, NONE, PARTIAL, RESEMBLES, UNKNOWN, Grade

# Part of the excess, and χ² over its expectation, from which much is left. With known noise a right name
# leaves less than a thousandth; the residual of an AO system has more shapes than its model. Complete models
# leave up to 1.14 on the bench, by errors of the discretisation, and on sky.
LEFT = {PHOTONS: 0.003, SPECKLES: 0.05, UNSEEN: 0.05}
LEFT_CHI2_NU = {PHOTONS: 1.3, SPECKLES: 1.2, UNSEEN: 1.2}
FAR_OFF = 3.0  # χ² over its expectation that no complete model leaves, however much was missing before

# Part of its own signal that a right name explains where it acts.
AT_ITS_PLACE = {PHOTONS: 0.95, SPECKLES: 0.9, UNSEEN: 0.9}


@dataclass(frozen=True)
class Judgement:
    """What the rest says of the names.

    Attributes
    ----------
    grade : str
    left : bool
        Whether a significant part of what was missing is still missing.
    shares : sequence of float
        Of every accepted name, see `share_at_its_place`.
    why_unknown : str
        What speaks against the names; empty if nothing does.
    """

    grade: Grade
    left: bool
    shares: Sequence[float]
    why_unknown: str = ""


def judged(search: Search, noise: NoiseVerdict, fine: FineStructure, options: Options) -> Judgement:
    """Judge what a search found by what it left.

    Parameters
    ----------
    search : Search
    noise : NoiseVerdict
    fine : FineStructure
        Of the final model.
    options : Options
    """
    left = much_is_left(search, noise.kind, options.sure)
    stack = search.null.stack
    shares = [share_at_its_place(one.refit, search.final) for one in search.accepted]
    without_speckles = [one for one in search.accepted if one.refit.effect.speckles and noise.kind == PHOTONS]
    if without_speckles:
        why = "a halo without the speckles that an AO residual makes from frame to frame"
        return Judgement(RESEMBLES, left, shares, why)
    if not search.accepted:
        if left:
            final = search.final.under(stack).excess
            return Judgement(
                UNKNOWN, left, shares, f"nothing in the catalogue explains χ²/ν {final.chi2_nu:.2f}"
            )
        if fine.significance > options.sure:
            why = (
                f"structure finer than the telescope can make, {fine.ratio:.1f} × the noise of the mean image"
            )
            return Judgement(UNKNOWN, left, shares, why)
        return Judgement(NONE, left, shares)
    if left and max(shares) < AT_ITS_PLACE[noise.kind]:
        name = search.accepted[0].name
        why = f"{name} leaves {1 - shares[0]:.1%} of its own signal where it acts"
        return Judgement(RESEMBLES, left, shares, why)
    left = left or search.final.under(search.null.stack).excess.chi2_nu > FAR_OFF
    return Judgement(PARTIAL if left else COMPLETE, left, shares)


def much_is_left(search: Search, kind: str, sure: float) -> bool:
    """Whether a significant part of what the model missed at first is still there.

    Parameters
    ----------
    search : Search
        A plain one, whose models have the same variances.
    kind : str
        Of the noise.
    sure : float
        Significance of a detection.
    """
    null, final = search.null.excess, search.final.under(search.null.stack).excess
    much = final.significance > sure and final.chi2_nu > LEFT_CHI2_NU[kind]
    return much and final.chi2 > LEFT[kind] * null.chi2


def share_at_its_place(one: Refit, final: Optimum) -> float:
    """Part of a name's own signal that a model explains where that signal lies.

    The signal is the change of the image by the name that no other parameter imitates. Its square weighs
    the excess of χ² with and without the name: a name that stands in for something else leaves much exactly
    where it acts.

    Parameters
    ----------
    one : Refit
    final : Optimum
        Of a model with the name.
    """
    stack = final.stack.without_model_error()
    plain = final.under(stack)
    change = (one.fitted.image_e - one.origin.fitted.image_e) * plain.root
    signal = one.origin.under(stack).project(change[:, None])[:, 0]
    weight = signal**2 / (signal**2).sum().clamp_min(1e-300)
    after = (weight * (plain.residual**2 - 1)).sum().clamp_min(0.0)
    before = (weight * (plain.residual + signal) ** 2).sum().clamp_min(1e-300)
    return float(1 - after / before)
