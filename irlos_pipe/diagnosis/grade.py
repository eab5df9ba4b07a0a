"""How complete a diagnosis is: whether much is left, where it lies, and what that says of the names."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from irlos_pipe.diagnosis.acceptance import Accepted, Comparison, Search
from irlos_pipe.diagnosis.checks import PHOTONS, SPECKLES, UNSEEN
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.null_model import FAR_OFF, Optimum
from irlos_pipe.diagnosis.records import FineStructure, Gap, NoiseVerdict, Options
from irlos_pipe.diagnosis.verdict import COMPLETE, NONE, PARTIAL, RESEMBLES, UNKNOWN, Grade
from irlos_pipe.effects.pupil_places import PupilPlace

# Part of the excess, and χ² over its expectation, from which much is left. With known noise a right name
# leaves less than a thousandth; the residual of an AO system has more shapes than its model. Complete models
# leave up to 1.14 on the bench, by errors of the discretisation, and on sky.
LEFT = {PHOTONS: 0.003, SPECKLES: 0.05, UNSEEN: 0.05}
LEFT_CHI2_NU = {PHOTONS: 1.3, SPECKLES: 1.2, UNSEEN: 1.2}

# Facts and modes follow the speckles of the frames that they see, which χ² does not show. In tuning runs
# right names closed 0.7 of the squared gap of held-out frames or came near its floor, but one of 14.
CLOSED = 0.6  # of the squared gap, that complete names close
AT_FLOOR = 1.2  # gap over its floor up to which nothing says that they do not

# Part of the squared gap without it that a name by itself closes on sky, where much is left. In tuning runs
# names that stood in for a keystone closed 0.3 at most; right ones, with a measured recording, 0.7.
BY_ITSELF = 0.5

# By chance three images on one side are in line in one of 2400 cases, two along rows or columns in one of
# 450. Three places of the pupil are a scratch.
IN_A_ROW, ALONG_PIXELS, ALIGNED_DEG = 3, 2, 3.0
TOUCHING = 1.5  # sum of the widths of two places in the pupil, within which they are one of another shape

# Part of its own signal that a right name explains where it acts.
AT_ITS_PLACE = {PHOTONS: 0.95, SPECKLES: 0.9, UNSEEN: 0.9}


@dataclass(frozen=True)
class Judgement:
    """What the residual says of the names."""

    grade: Grade
    left: bool  # whether a significant part of what was missing is still missing
    search: Search  # what was found, with the names that are believed
    shares: Sequence[float]  # of every name, see `share_at_its_place`
    why_unknown: str = ""  # what speaks against the names; empty if nothing does


def judged(search: Search, noise: NoiseVerdict, fine: FineStructure, gap: Gap, options: Options) -> Judgement:
    """Judge what a search found by what it left.

    `fine` is the structure that the final model leaves, `gap` that of the models without and with the names.
    """
    far_off = bool(search.accepted) and search.remaining.chi2_nu > FAR_OFF
    left = far_off or much_is_left(search, noise.kind, options.sure)
    if left and (noise.kind == PHOTONS or not closes(gap)):  # on sky some χ² is always left
        search = without_ordinary_facts(search)
    if left and noise.kind != PHOTONS:
        search = without_minor_names(search)
    shares = [share_at_its_place(one, search.final) for one in search.accepted]
    grade, why = _graded(search, shares, noise.kind, left, options.sure)
    if grade == NONE and fine.significance > options.sure:
        grade = UNKNOWN
        why = f"structure finer than the telescope can make, {fine.ratio:.1f} × the noise of the mean image"
    return Judgement(grade, left, search, shares, why)


def _graded(search: Search, shares: Sequence[float], kind: str, left: bool, sure: float) -> tuple[Grade, str]:
    """The grade, and what speaks against the names."""
    names = search.accepted
    if not names:
        null = search.null.excess  # what is only adjusted may stand in for what was missing at first
        missing = left or (null.significance > sure and null.chi2_nu > LEFT_CHI2_NU[kind])
        return (UNKNOWN, _unexplained(search, left)) if missing else (NONE, "")
    if kind == PHOTONS and any(one.effect.speckles for one in names):
        return RESEMBLES, "a halo without the speckles that an AO residual makes from frame to frame"
    if copies := copies_in_a_row(search.final.fitted):
        return RESEMBLES, f"{copies} copies of the star in one direction, as a detector makes them"
    if name := one_place_twice(search.final.fitted):
        return RESEMBLES, f"{name} is twice in one place of the pupil, and makes another shape"
    present = Counter(one.name for one in search.final.fitted.effects)
    places = (one.name for one in names if isinstance(one.base, PupilPlace))
    if name := next((name for name in places if present[name] >= IN_A_ROW), ""):
        return RESEMBLES, f"{name} is in {present[name]} places of the pupil, which make another shape"
    if left and max(shares) < AT_ITS_PLACE[kind]:
        return RESEMBLES, f"{names[0].name} leaves {1 - shares[0]:.1%} of its own signal where it acts"
    return (PARTIAL if left else COMPLETE), ""


def _unexplained(search: Search, left: bool) -> str:
    """What nothing explains, in words."""
    before, after = search.null.excess.chi2_nu, search.remaining.chi2_nu
    lower = f"lower χ²/ν from {before:.2f} to {after:.2f}"
    if search.adjusted:
        lowered = f"{', '.join(search.adjusted)}, of which none is sure, {lower}"
        return f"{lowered}, and nothing explains the rest" if left else lowered
    if left or not search.tolerant:
        return f"nothing in the catalogue explains χ²/ν {after:.2f}"
    last = search.final.fitted.problem.layout.nolls[-1]
    return f"no name is sure, and modes beyond Noll {last} {lower}"


def closes(gap: Gap) -> bool:
    """Whether names close the gap of held-out frames, or come near its floor."""
    return not (gap.closed < CLOSED and gap.after > AT_FLOOR * gap.floor)


def without_ordinary_facts(search: Search) -> Search:
    """What was found, but for facts of the instrument at ordinary values, which a model adjusts.

    Where something is missing that no name explains, the facts take up a part of it: values as any instrument
    has them do not tell whether they are its own.
    """
    return _adjusting(search, [one for one in search.accepted if one.base.fact and one.ordinary])


def without_minor_names(search: Search) -> Search:
    """What was found, but for names that close little of the gap without them.

    Where speckles are all that is known of the noise and something is missing, whatever is smooth and
    symmetric takes up a part of it, significantly, in frames that no fit has seen as well. A copy of the star
    has a place of its own, where little may be left (`share_at_its_place`).
    """
    minor = [one for one in search.accepted if one.gap.closed < BY_ITSELF and not one.base.copies_star]
    return _adjusting(search, minor)


def _adjusting(search: Search, names: Sequence[Accepted]) -> Search:
    """What was found, some of its names only adjusted."""
    less_sure = {id(one) for one in names}
    adjusted = [*search.adjusted, *(one.label for one in search.accepted if id(one) in less_sure)]
    kept = [one for one in search.accepted if id(one) not in less_sure]
    nearest = search.nearest if kept else next(iter(names), search.nearest)
    return replace(search, accepted=kept, adjusted=adjusted, nearest=nearest)


def copies_in_a_row(fitted: Fitted) -> int:
    """Number of copies of the star in one direction, if they are too many for stars and ghosts; or 0.

    Along rows or columns, on both sides of the star, the detector makes them: there fewer are too many.
    """
    copies = [label for label in fitted.problem.effects.labels if fitted.effect(label).base.copies_star]
    angles = [fitted.effect(label).base.describe(fitted.values_of(label))["pa_deg"] for label in copies]
    in_line = max((_near(angles, one, 360.0) for one in angles), default=0)
    along_pixels = max(_near(angles, axis, 180.0) for axis in (0.0, 90.0))
    if in_line >= IN_A_ROW:
        return in_line
    return along_pixels if along_pixels >= ALONG_PIXELS else 0


def one_place_twice(fitted: Fitted) -> str:
    """Name of an effect that is twice in one place of the pupil, where two make another shape; or nothing."""
    labels = fitted.problem.effects.labels
    places = [label for label in labels if isinstance(fitted.effect(label).base, PupilPlace)]
    for one, other in combinations(places, 2):
        name = fitted.effect(one).base.name
        (_, x1, y1, width1), (_, x2, y2, width2) = (fitted.values_of(label) for label in (one, other))
        touch = np.hypot(x2 - x1, y2 - y1) < TOUCHING * (width1 + width2)
        if touch and name == fitted.effect(other).base.name:
            return name
    return ""


def _near(angles_deg: Sequence[float], to_deg: float, period_deg: float) -> int:
    """How many angles are near another one."""
    half = period_deg / 2
    return sum(abs((one - to_deg + half) % period_deg - half) < ALIGNED_DEG for one in angles_deg)


def much_is_left(search: Search, kind: str, sure: float) -> bool:
    """Whether a significant part of what the model missed at first is still there, with noise of a `kind`."""
    null, final = search.null.excess, search.remaining
    much = final.significance > sure and final.chi2_nu > LEFT_CHI2_NU[kind]
    return much and final.chi2 > LEFT[kind] * null.chi2


def share_at_its_place(one: Comparison, final: Optimum) -> float:
    """Part of a name's own signal that the `final` model with it explains where that signal lies.

    The signal is the change of the image by the name that no other parameter imitates. Its square weighs the
    excess of χ² with and without the name: a name that stands in for something else leaves much exactly where
    it acts. What is smooth may have taken up a part of the model's error, which excuses nothing there; a copy
    of the star does not, and near its core that error is noise as any other.
    """
    stack = final.stack if one.base.copies_star else final.stack.without_model_error()
    plain, origin = final.under(stack), one.origin.under(stack)
    signal = origin.project(origin.change_to(one.fitted)[:, None])[:, 0]
    weight = signal**2 / (signal**2).sum().clamp_min(1e-300)
    after = (weight * (plain.residual**2 - 1)).sum().clamp_min(0.0)
    before = (weight * (plain.residual + signal) ** 2).sum().clamp_min(1e-300)
    return float(1 - after / before)
