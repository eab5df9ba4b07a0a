"""Files that come with the package: recipes, specifications of simulations, sample recordings.

An installed package holds them in its folder ``shipped``; in a checkout they are folders at its top.
"""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import irlos_pipe
from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion

Kind = Literal["recipes", "recipes/simulations", "recipes/paper", "data_samples"]
RECIPES: Kind = "recipes"
SIMULATIONS: Kind = "recipes/simulations"
PAPER: Kind = "recipes/paper"
SAMPLES: Kind = "data_samples"


def shipped_folder(kind: Kind) -> Path:
    """Return the folder with the files of a `kind`.

    Raises `ConfigurationError` when the package was installed without them.
    """
    package = Path(irlos_pipe.__file__).resolve().parent
    places = [place / kind for place in (package / "shipped", package.parent)]
    for place in places:
        if place.is_dir():
            return place
    raise ConfigurationError(f"{places[0]}: not there; install irlos_pipe again, from a wheel or a checkout")


def shipped_names(kind: Kind) -> list[str]:
    return sorted(path.stem for path in shipped_folder(kind).glob("*.yaml"))


def named_file(given: str | Path, kind: Kind) -> Path:
    """Return the path `given`, or the shipped file of a `kind` that it names, such as ``ncpa_calibration``.

    A file of the user's goes first.

    Raises `ConfigurationError` when a name without a suffix is neither.
    """
    path = Path(given)
    if os.path.isfile(path):
        return path
    shipped = shipped_folder(kind) / path.parent / f"{path.name.removesuffix('.yaml')}.yaml"
    if os.path.isfile(shipped):
        return shipped
    if path.suffix or path.is_absolute() or len(path.parts) > 1:
        return path  # whoever reads it says what is wrong
    names = shipped_names(kind)
    hint = suggestion(path.name, names) or f"; there are {', '.join(names)}"
    raise ConfigurationError(f"{path}: no such file, and nothing of this name in {kind}{hint}")


def are_samples(paths: Iterable[Path]) -> bool:
    """Return whether any of the `paths` lies among the sample recordings of the package."""
    folder = shipped_folder(SAMPLES).resolve()
    return any(path.resolve().is_relative_to(folder) for path in paths)
