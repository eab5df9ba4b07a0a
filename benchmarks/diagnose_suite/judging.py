"""Whether the right thing was named, with the right size; outcomes sorted by what can be asked of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from benchmarks.diagnose_suite.cases import CLEAN, OUTSIDE, PAIR, SINGLE
from benchmarks.harness import Outcome
from irlos_pipe.conventions.bands import NARROW_H
from irlos_pipe.effects.base import kind_of

NONE, EFFECT, UNKNOWN = "none", "effect", "unknown"
GRADES = ("complete", "partial", "resembles", UNKNOWN, NONE)
LARGEST_SET = 3
NEAR_MAS = 41.0  # λ/D at 1.6 µm: within it a second image is where it is said to be
SECOND_IMAGES = ("companion", "ghost")
CONFIDENCE = 0.95
NEGLIGIBLE = 1e-9  # a component of a direction that is zero but for rounding
PETAL_KINDS = ("piston_nm", "tip_nm", "tilt_nm")  # of which the mean belongs to the whole pupil
CLEARLY_THERE = 3.0  # times the smallest detectable size, below which a hidden effect is small


def is_dirty(outcome: Outcome) -> bool:
    """Whether everything has a mild error besides what is hidden."""
    return bool(outcome["truth"].get("dirty", False))


def grade(outcome: Outcome) -> str:
    """How far the diagnosis says to have come, one of `GRADES`; a report without grades has the verdict's."""
    diagnosis = outcome["diagnosis"]
    if "grade" in diagnosis:
        return diagnosis["grade"]
    if diagnosis["verdict"] == EFFECT:
        return "partial" if diagnosis.get("unexplained", False) else "complete"
    return diagnosis["verdict"]


def named(outcome: Outcome) -> list[str]:
    """Names in the order found; none unless the verdict is that an effect was found."""
    return [step["effect"] for step in _adopted(outcome)]


def ambiguity_sets(outcome: Outcome) -> list[set[str]]:
    """Every name with those that it was not distinguished from."""
    return [{step["effect"], *step["indistinguishable"]} for step in _adopted(outcome)]


def _adopted(outcome: Outcome) -> list[Mapping[str, Any]]:
    """Steps of the diagnosis, each with the effect itself in the place of its label."""
    steps = outcome["diagnosis"]["steps"] if outcome["diagnosis"]["verdict"] == EFFECT else []
    return [{**step, "effect": kind_of(step["effect"])} for step in steps]


def is_first(outcome: Outcome) -> bool:
    """Whether the hidden effect is the first name."""
    return any(_is_hidden(outcome, step) for step in _adopted(outcome)[:1])


def is_named(outcome: Outcome) -> bool:
    """Whether the hidden effect is one of the names."""
    return any(_is_hidden(outcome, step) for step in _adopted(outcome))


def is_in_set(outcome: Outcome) -> bool:
    """Whether the hidden effect is the first name, or in its ambiguity set of at most three."""
    first = ambiguity_sets(outcome)[:1]
    return bool(first) and len(first[0]) <= LARGEST_SET and outcome["truth"]["effects"][0] in first[0]


def all_named(outcome: Outcome) -> bool:
    """Whether every hidden effect is a name, or in the set of a name of its own."""
    hidden, steps = outcome["truth"]["effects"], _adopted(outcome)
    elsewhere = [step["effect"] in hidden and not _is_hidden(outcome, step) for step in steps]
    sets = [alike for alike, off in zip(ambiguity_sets(outcome), elsewhere, strict=True) if not off]
    found = {step["effect"] for step, off in zip(steps, elsewhere, strict=True) if not off}
    return found >= set(hidden) or _matched(hidden, sets)


def _matched(hidden: Sequence[str], sets: Sequence[set[str]]) -> bool:
    """Whether every name can be given a set that holds it, no set twice."""
    if not hidden:
        return True
    first, *rest = hidden
    return any(first in one and _matched(rest, [*sets[:i], *sets[i + 1 :]]) for i, one in enumerate(sets))


def extra_names(outcome: Outcome) -> list[str]:
    """Names of effects that are not there; one that an ambiguity set excuses is none."""
    hidden = set(outcome["truth"]["effects"])
    return [
        name
        for name, alike in zip(named(outcome), ambiguity_sets(outcome), strict=True)
        if not hidden & alike
    ]


def is_in_some_set(outcome: Outcome) -> bool:
    """Whether the hidden effect is one of the names, or in the ambiguity set of at most three of one."""
    sets = [one for one in ambiguity_sets(outcome) if len(one) <= LARGEST_SET]
    return is_named(outcome) or any(outcome["truth"]["effects"][0] in one for one in sets)


def is_untestable(outcome: Outcome) -> bool:
    """Whether nothing was found, and the diagnosis says that these data cannot show the hidden effect.

    Where everything has a mild error, others may be found: those that are there.
    """
    hidden, diagnosis = set(outcome["truth"]["effects"]), outcome["diagnosis"]
    found = (
        is_named(outcome) or first_is_wrong(outcome) if is_dirty(outcome) else diagnosis["verdict"] != NONE
    )
    return not found and bool(hidden & set(diagnosis["untestable"]))


# -- jointly with mild errors of everything ----------------------------------------------------------


def first_is_wrong(outcome: Outcome) -> bool:
    """Whether the first name is neither what is hidden nor a mild error that is there."""
    return any(not _is_there(outcome, step) for step in _adopted(outcome)[:1])


def wrong_names(outcome: Outcome) -> list[str]:
    """Names of what is neither hidden nor a mild error that is there."""
    return [step["effect"] for step in _adopted(outcome) if not _is_there(outcome, step)]


def _is_there(outcome: Outcome, step: Mapping[str, Any]) -> bool:
    """Whether a name is that of something hidden, what is not distinguished from it, or a mild error."""
    mild = outcome["truth"].get("mild", {})
    if _is_hidden(outcome, step) or set(outcome["truth"]["effects"]) & set(step["indistinguishable"]):
        return True
    if step["effect"] in SECOND_IMAGES:
        known = outcome["truth"].get("known", {})
        images = [table[name] for table in (mild, known) for name in SECOND_IMAGES if name in table]
        return any(_distance_mas(step["parameters"], one) < NEAR_MAS for one in images)
    return step["effect"] in mild


def _is_hidden(outcome: Outcome, step: Mapping[str, Any]) -> bool:
    """Whether a name is that of a hidden effect; a second image next to a ghost has to be in its place."""
    truth, effect = outcome["truth"], step["effect"]
    if effect not in SECOND_IMAGES or "ghost" not in truth.get("mild", {}):
        return effect in truth["effects"]
    return effect in truth["effects"] and _distance_mas(step["parameters"], truth["known"][effect]) < NEAR_MAS


def _distance_mas(one: Mapping[str, float], other: Mapping[str, float]) -> float:
    places = [each["sep_mas"] * np.exp(1j * np.deg2rad(each["pa_deg"])) for each in (one, other)]
    return float(abs(places[0] - places[1]))


# -- the case as a whole -----------------------------------------------------------------------


def is_right(outcome: Outcome) -> bool:
    """Whether the case came out as it should."""
    kind, verdict = outcome["truth"]["kind"], outcome["diagnosis"]["verdict"]
    if is_dirty(outcome):
        # What is hidden is among the names, if the catalogue has it and the data can show it.
        unseen = kind.endswith((CLEAN, OUTSIDE)) or is_untestable(outcome)
        found = all_named(outcome) if kind == PAIR else unseen or is_named(outcome)
        return found and not first_is_wrong(outcome)
    if kind.endswith(CLEAN):
        return verdict == NONE
    if kind.endswith(OUTSIDE):
        return verdict == UNKNOWN
    if kind == PAIR:
        return all_named(outcome) and not extra_names(outcome)
    return is_untestable(outcome) or (is_in_set(outcome) and not extra_names(outcome))


# -- whether a size is right, and how large it is for what can be seen -------------------------


def true_size_inside(outcome: Outcome) -> bool | None:
    """Whether the true size lies in the quoted 95 % interval; None if nothing was quoted.

    Of an effect with several sizes (modes, petals), ``Σ ((found − true)/σ)²`` is compared with the 95 %
    point of χ²; errors of different sizes are taken as independent.
    """
    (effect,) = outcome["truth"]["effects"]
    step = next((one for one in outcome["diagnosis"]["steps"] if one["effect"] == effect), None)
    if step is None or not is_first(outcome):
        return None
    truth = outcome["truth"]["sizes"][effect]
    if effect == "bad_pixels":
        return sorted(map(list, step["parameters"]["pixels"])) == sorted(truth["pixels"])
    found, true, sigma = _aligned(step, truth)
    if not np.all(np.isfinite(sigma)) or not np.all(sigma > 0):
        return False
    return bool(np.sum(((found - true) / sigma) ** 2) <= stats.chi2.ppf(CONFIDENCE, len(true)))


def _aligned(step: Mapping[str, Any], truth: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Found sizes, true ones and standard errors in one order; modes that one of them lacks are zero."""
    rows = []
    for key, value in truth.items():
        found, true = _leaves(key, step["parameters"].get(key)), _leaves(key, value)
        sigma = _leaves("", step["sigma"].get(key))
        rows += [(found.get(at, 0.0), true.get(at, 0.0), sigma.get(at, np.nan)) for at in {**true, **found}]
    return tuple(np.array(rows, float).T)


def _leaves(key: str, value: Any) -> dict[str, float]:
    """Numbers by their place in a public value; petals without their mean."""
    if value is None:
        return {}
    if isinstance(value, list):
        numbers = np.array(value, float)
        value = dict(enumerate(numbers - (numbers.mean() if key in PETAL_KINDS else 0.0)))
    if not isinstance(value, Mapping):
        value = {"": value}
    return {str(place): np.nan if one is None else float(one) for place, one in value.items()}


def in_smallest(outcome: Outcome, smallest: Mapping[str, Any]) -> float:
    """Size of the hidden effect over its smallest detectable one (MDB); NaN where that is not known.

    ``sqrt(Σ (size / MDB)²)`` over modes or petals: the root of the expected gain of χ² over that at which
    an effect counts as seen.
    """
    (effect,) = outcome["truth"]["effects"]
    truth, mdb = outcome["truth"]["sizes"].get(effect, {}), smallest.get(effect, {})
    ratios = [
        (number - NARROW_H.centre_nm if key == "wavelength_nm" else number) / smallest_one
        for key in truth
        if key in mdb
        for place, number in _leaves(key, truth[key]).items()
        if (smallest_one := abs(_leaves("", mdb[key]).get(place, 0.0))) > NEGLIGIBLE
    ]
    return float(np.linalg.norm(ratios)) if ratios else float("nan")


# -- outcomes sorted by what can be asked of them ----------------------------------------------


class Singles(NamedTuple):
    """Recordings with one hidden effect, by what can be asked of them."""

    testable: Sequence[Outcome]
    small: Sequence[Outcome]
    untestable: Sequence[Outcome]


def in_world(outcomes: Sequence[Outcome], dirty: bool) -> list[Outcome]:
    """Outcomes of cases with mild errors of everything (`dirty`), or of those without."""
    return [one for one in outcomes if is_dirty(one) == dirty]


def of_kind(outcomes: Sequence[Outcome], kind: str) -> list[Outcome]:
    """Outcomes of one kind of case."""
    return [one for one in outcomes if one["truth"]["kind"] == kind]


def smallest_sizes(
    outcomes: Sequence[Outcome], clean: str = CLEAN, dirty: bool = False
) -> dict[str, dict[str, Any]]:
    """Smallest detectable sizes in every setting: those of the median of its recordings with nothing hidden.

    Beside mild errors (`dirty`) they are larger, as these imitate a part of what is hidden; effects of which
    such recordings state none, because they have them, keep the size without mild errors.
    """
    smallest: dict[str, dict[str, Any]] = {}
    for world in (False, True) if dirty else (False,):
        tables: dict[str, list[Mapping]] = {}
        for one in of_kind(in_world(outcomes, world), clean):
            tables.setdefault(one["truth"]["setting"], []).append(one["diagnosis"]["mdb"])
        for setting, several in tables.items():
            smallest[setting] = smallest.get(setting, {}) | _median(several)
    return smallest


def _median(tables: Sequence[Any]) -> Any:
    """Median of equally built tables, number by number, over those that have it."""
    present = [one for one in tables if one is not None]
    if not present:
        return None
    if isinstance(present[0], Mapping):
        keys = {key: None for one in present for key in one}
        return {key: _median([one.get(key) for one in present]) for key in keys}
    if isinstance(present[0], list):
        return [_median(list(group)) for group in zip(*present, strict=True)]
    return float(np.median(np.abs(present)))


def sorted_singles(
    outcomes: Sequence[Outcome],
    kind: str = SINGLE,
    clean: str = CLEAN,
    dirty: bool = False,
    smallest: Mapping[str, Mapping[str, Any]] | None = None,
) -> Singles:
    """Split the recordings with one effect, jointly with mild errors of everything (`dirty`) or alone.

    An effect is untestable where the diagnosis says so, and small below `CLEARLY_THERE` times the `smallest`
    detectable size, of such recordings unless given; where that is not known it counts as large.
    """
    smallest = smallest_sizes(outcomes, clean, dirty) if smallest is None else smallest
    singles = of_kind(in_world(outcomes, dirty), kind)
    untestable = [one for one in singles if is_untestable(one)]
    rest = [one for one in singles if not is_untestable(one)]
    sizes = [in_smallest(one, smallest.get(one["truth"]["setting"], {})) for one in rest]
    small = [one for one, size in zip(rest, sizes, strict=True) if size < CLEARLY_THERE]
    return Singles([one for one in rest if one not in small], small, untestable)
