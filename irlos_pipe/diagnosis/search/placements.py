"""Families of effects that may be missing in recordings of several moments, each where it may act."""

from __future__ import annotations

from collections.abc import Sequence

from irlos_pipe.diagnosis.moments import Moments, Placement
from irlos_pipe.diagnosis.search.scores import Family
from irlos_pipe.effects import CATALOGUE, Effect


def placed_families(moments: Moments, present: Sequence[Effect]) -> tuple[list[Family], list[str]]:
    """Families for all moments, and for single stars or moments, that a model does not have there.

    A wider form of an effect is looked for by itself where it belongs to something else: of several stars a
    companion belongs to one, a ghost to all.

    Parameters
    ----------
    moments : Moments
        Several.
    present : sequence of Effect
        What the model has.

    Returns
    -------
    list of Family
    list of str
        Effects that mean nothing under these conditions.
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
