"""Whether the right thing was named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.diagnose_suite.cases import CLEAN, OUTSIDE, PAIR

NONE, EFFECT, UNKNOWN = "none", "effect", "unknown"
LARGEST_SET = 3
Outcome = Mapping[str, Any]


def named(outcome: Outcome) -> list[str]:
    """Names in the order found; none unless the verdict is that an effect was found."""
    diagnosis = outcome["diagnosis"]
    return [step["effect"] for step in diagnosis["steps"]] if diagnosis["verdict"] == EFFECT else []


def ambiguity_sets(outcome: Outcome) -> list[set[str]]:
    """Every name with those that it was not distinguished from."""
    steps = outcome["diagnosis"]["steps"] if outcome["diagnosis"]["verdict"] == EFFECT else []
    return [{step["effect"], *step["indistinguishable"]} for step in steps]


def is_first(outcome: Outcome) -> bool:
    """Whether the hidden effect is the first name."""
    return named(outcome)[:1] == outcome["truth"]["effects"][:1]


def is_in_set(outcome: Outcome) -> bool:
    """Whether the hidden effect is the first name, or in its ambiguity set of at most three."""
    first = ambiguity_sets(outcome)[:1]
    return bool(first) and len(first[0]) <= LARGEST_SET and outcome["truth"]["effects"][0] in first[0]


def all_named(outcome: Outcome) -> bool:
    """Whether every hidden effect is a name, or in the set of a name of its own."""
    hidden, sets = outcome["truth"]["effects"], ambiguity_sets(outcome)
    return all(name in named(outcome) for name in hidden) or _matched(hidden, sets)


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


def is_untestable(outcome: Outcome) -> bool:
    """Whether nothing was found, and the diagnosis says that these data cannot show the hidden effect."""
    hidden, diagnosis = set(outcome["truth"]["effects"]), outcome["diagnosis"]
    return diagnosis["verdict"] == NONE and bool(hidden & set(diagnosis["untestable"]))


# -- the case as a whole -----------------------------------------------------------------------


def is_right(outcome: Outcome) -> bool:
    """Whether the case came out as it should."""
    kind, verdict = outcome["truth"]["kind"], outcome["diagnosis"]["verdict"]
    if kind.endswith(CLEAN):
        return verdict == NONE
    if kind.endswith(OUTSIDE):
        return verdict == UNKNOWN
    if kind == PAIR:
        return all_named(outcome) and not extra_names(outcome)
    return is_untestable(outcome) or (is_in_set(outcome) and not extra_names(outcome))
