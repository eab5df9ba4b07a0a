"""The families of effects that a cube can show."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from irlos_pipe.effects import CATALOGUE, Conditions, Effect


@dataclass(frozen=True)
class Family:
    """One effect that may be missing.

    Attributes
    ----------
    variants : tuple of Effect
        Shapes of the same effect that are tried.
    positions : int
        Where the effect was looked for before, of which these are the best.
    """

    variants: tuple[Effect, ...]
    positions: int = 1

    @property
    def effect(self) -> Effect:
        """The first of the variants."""
        return self.variants[0]


def families(conditions: Conditions, present: Iterable[str]) -> tuple[list[Family], list[str]]:
    """Families that a score test finds, beside the effects that the model has.

    Parameters
    ----------
    conditions : Conditions
    present : iterable of str
        Names of the effects of the model.

    Returns
    -------
    list of Family
    list of str
        Effects that mean nothing under these conditions.
    """
    model, found, meaningless = {*present}, [], []
    for name, kind in CATALOGUE.items():
        if kind.found_by != "score" or name in model:
            continue
        try:
            found.append(Family(kind.variants(conditions)))
        except ValueError:
            meaningless.append(name)
    return found, meaningless
