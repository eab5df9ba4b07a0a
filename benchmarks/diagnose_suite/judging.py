"""Whether the right thing was named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.cases import CLEAN, OUTSIDE, PAIR
from irlos_pipe.effects.base import kind_of

NONE, EFFECT, UNKNOWN = "none", "effect", "unknown"
GRADES = ("complete", "partial", "resembles", UNKNOWN, NONE)
LARGEST_SET = 3
NEAR_MAS = 41.0  # λ/D at 1.6 µm: within it a second image is where it is said to be
SECOND_IMAGES = ("companion", "ghost")
Outcome = Mapping[str, Any]


def is_dirty(outcome: Outcome) -> bool:
    """Whether everything has a mild error beside what is hidden."""
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


# -- beside mild errors of everything ----------------------------------------------------------


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
    """Whether a name is that of a hidden effect; a second image beside a ghost has to be in its place."""
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
        return not first_is_wrong(outcome) and _is_found_beside_others(outcome)
    if kind.endswith(CLEAN):
        return verdict == NONE
    if kind.endswith(OUTSIDE):
        return verdict == UNKNOWN
    if kind == PAIR:
        return all_named(outcome) and not extra_names(outcome)
    return is_untestable(outcome) or (is_in_set(outcome) and not extra_names(outcome))


def _is_found_beside_others(outcome: Outcome) -> bool:
    """Whether what is hidden is among the names, if the catalogue has it and the data can show it."""
    kind = outcome["truth"]["kind"]
    if kind == PAIR:
        return all_named(outcome)
    return kind.endswith((CLEAN, OUTSIDE)) or is_named(outcome) or is_untestable(outcome)
