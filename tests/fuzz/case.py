"""What a case is, and the list of all kinds of cases."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Case:
    """A command line on a spoiled input."""

    summary: str  # what was done to the input
    arguments: tuple[str, ...]  # after ``irlos``; files are written to ``<folder>/out`` only
    reference: str = ""  # unspoiled recording whose result must come out; empty if none is compared
    plausible: bool = False  # the input is as valid as before and says something else: nobody can notice
    place: bool = False  # the place for the results is spoiled: exit code 1 or 75 in one line is right, too


Maker = Callable[[Path, np.random.Generator], Case]
KINDS: dict[str, Maker] = {}


def kind(maker: Maker) -> Maker:
    """Enter a function that makes cases into the list, under its own name."""
    KINDS[maker.__name__] = maker
    return maker


def draw(name: str, seed: int, folder: Path) -> Case:
    """Write the inputs of a case into an empty folder; kind and seed determine it."""
    return KINDS[name](folder, np.random.default_rng([seed, sorted(KINDS).index(name)]))


def run_of(folder: Path, *options: str, recipe: Path | None = None) -> tuple[str, ...]:
    """Return the arguments that run the recipe of a case."""
    path = recipe or folder / "recipe.yaml"
    return ("run", str(path), "--output", str(folder / "out"), "--jobs", "1", "--device", "cpu", *options)


def pick(rng: np.random.Generator, choices: list):
    """One of the choices, as it is (NumPy would turn it into an array)."""
    return choices[int(rng.integers(len(choices)))]
