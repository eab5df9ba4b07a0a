"""Stars and nights of recordings in a multi-epoch diagnosis.

A moment is one star at one time: its recordings share the sky and the wavefront. What belongs to the
instrument is common to all moments, what belongs to a star to all moments of that star.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.effects import Conditions, Effect

Placement = frozenset[int] | None  # moments in which an effect acts; None: all


@dataclass(frozen=True)
class Moment:
    """One star at one time."""

    name: str  # for people
    star: str  # equal names are the same star
    conditions: Conditions  # of its first recording


@dataclass(frozen=True)
class Moments:
    """All moments, by number."""

    by_number: Mapping[int, Moment]

    @classmethod
    def of(cls, recordings: Sequence[Exposures]) -> Moments:
        by_number: dict[int, Moment] = {}
        for one in recordings:
            by_number.setdefault(one.moment, Moment(one.name, one.star, one.conditions))
        return cls(by_number)

    @property
    def several(self) -> bool:
        return len(self.by_number) > 1

    @property
    def by_star(self) -> dict[str, frozenset[int]]:
        """Moments of every star."""
        stars = dict.fromkeys(one.star for one in self.by_number.values())
        return {star: frozenset(n for n, one in self.by_number.items() if one.star == star) for star in stars}

    @property
    def each(self) -> list[frozenset[int]]:
        """Every moment by itself."""
        return [frozenset({number}) for number in self.by_number]

    def conditions_of(self, placement: Placement) -> Conditions:
        """Conditions of the first of the moments in which an effect acts."""
        number = next(n for n in self.by_number if placement is None or n in placement)
        return self.by_number[number].conditions

    def names_of(self, placement: Placement) -> list[str]:
        """Names of the moments in which an effect acts."""
        return [one.name for n, one in self.by_number.items() if placement is None or n in placement]

    def placements(self, kind: type[Effect] | Effect) -> list[Placement]:
        """Where effects of a `kind` are looked for: with what they belong to.

        What belongs to the instrument is common to all moments; one moment may still be alone in showing it.
        """
        if kind.belongs_to == "instrument":
            return [None, *(self.each if self.several else ())]
        return self.own_placements(kind)

    def own_placements(self, kind: type[Effect] | Effect) -> list[Placement]:
        """Where effects of a `kind` that are no instrument's have values of their own: per star or moment."""
        own = list(self.by_star.values()) if kind.belongs_to == "star" else self.each
        return [None] if len(own) == 1 else [*own]


def placed(by_moment: Mapping[int, Sequence[Effect]], moments: Moments) -> list[Effect]:
    """The effects of a model of several moments.

    For every moment `by_moment` has the same effects, as its conditions make them. What belongs to the
    instrument or is held is returned once, what belongs to a star or a moment for each of these.
    """
    found: list[Effect] = []
    for alike in zip(*by_moment.values(), strict=True):
        first, numbered = alike[0], dict(zip(by_moment, alike, strict=True))
        if first.belongs_to == "instrument" or not first.parameters:
            found.append(first)
            continue
        for placement in moments.own_placements(first):
            number = next(n for n in numbered if placement is None or n in placement)
            found.append(numbered[number].only_in(placement))
    return found
