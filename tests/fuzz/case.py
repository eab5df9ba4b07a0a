"""What a case is, and the list of all kinds of cases."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Case:
    """A command line on a spoiled input.

    Attributes
    ----------
    summary : str
        What was done to the input.
    arguments : tuple of str
        After ``irlos``; files are written to ``<folder>/out`` only.
    reference : str
        Name of the unspoiled recording whose result must come out; empty if nothing is to be compared.
    plausible : bool
        The input is as valid as before and says something else: nobody can notice.
    place : bool
        The place for the results is spoiled: exit code 1 or 75 in one line is right as well.
    """

    summary: str
    arguments: tuple[str, ...]
    reference: str = ""
    plausible: bool = False
    place: bool = False


Maker = Callable[[Path, np.random.Generator], Case]
KINDS: dict[str, Maker] = {}


def kind(maker: Maker) -> Maker:
    """Enter a function that makes cases into the list, under its own name."""
    KINDS[maker.__name__] = maker
    return maker


def draw(name: str, seed: int, folder: Path) -> Case:
    """Write the inputs of a case into an empty folder; kind and seed determine it."""
    return KINDS[name](folder, np.random.default_rng([seed, sorted(KINDS).index(name)]))


def pick(rng: np.random.Generator, choices: list):
    """One of the choices, as it is (NumPy would turn it into an array)."""
    return choices[int(rng.integers(len(choices)))]
