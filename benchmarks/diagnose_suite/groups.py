"""Outcomes sorted by what can be asked of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.cases import CLEAN, SINGLE
from benchmarks.diagnose_suite.judging import Outcome, is_dirty, is_untestable
from benchmarks.diagnose_suite.sizes import in_smallest

CLEARLY_THERE = 3.0  # times the smallest detectable size


@dataclass(frozen=True)
class Singles:
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
    """Split the recordings with one effect, beside mild errors of everything (`dirty`) or alone.

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
