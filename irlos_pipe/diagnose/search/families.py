"""The families of effects that a cube can show, and where to look for each."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from irlos_pipe.effects import CATALOGUE, Conditions, Effect
from irlos_pipe.effects.motion import Vibration

NOT_IN_A_CUBE = ("focus_stage_hysteresis", "focus_stage_offset", "focus_stage_scale")
ELSEWHERE = ("bad_pixels", "ncpa_drift")  # looked for by themselves: pixel by pixel, frame by frame


@dataclass(frozen=True)
class Family:
    """One effect that may be missing.

    Attributes
    ----------
    name : str
    variants : tuple of Effect
        Shapes of the same effect that are tried.
    places : int
        Where the effect was looked for before, of which these are the best.
    """

    name: str
    variants: tuple[Effect, ...]
    places: int = 1


def families(conditions: Conditions, present: Iterable[str]) -> tuple[list[Family], list[str]]:
    """Families to test beside the effects that the model has, and names that mean nothing here."""
    absent = [n for n in CATALOGUE if n not in {*present, *ELSEWHERE, *NOT_IN_A_CUBE}]
    found, meaningless = [], []
    for name in absent:
        try:
            found.append(Family(name, _variants(name, conditions)))
        except ValueError:
            meaningless.append(name)
    return found, meaningless


def _variants(name: str, conditions: Conditions) -> tuple[Effect, ...]:
    if name == Vibration.name:
        return tuple(Vibration.under(conditions, shape=shape) for shape in ("sinusoidal", "gaussian"))
    return (CATALOGUE[name].under(conditions),)


def names_of(effects: Sequence[Effect]) -> list[str]:
    """Names of effects."""
    return [effect.name for effect in effects]
