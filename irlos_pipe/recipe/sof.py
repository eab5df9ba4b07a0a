"""Sets of frames: text files with a path and a tag per line, as ESO's tools hand them to a recipe."""

import re
from collections.abc import Sequence
from os.path import expandvars
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.conventions.text import printable, suggestion
from irlos_pipe.files.regular import read_regular
from irlos_pipe.files.shipped import RECIPES, named_file
from irlos_pipe.files.yaml import load_yaml

Frame = tuple[str, str]  # path and tag
# Inputs that a tag stands for, the first that the recipe has; any recipe may have an input of the tag's name.
INPUTS_OF = {
    "NCPA_CALIBRATION": ("calibration", "cube"),
    "DEFOCUS_RAMP": ("ramp",),
    "DEROTATOR": ("cube",),
    "PSF": ("cube", "calibration"),
}
LINE = re.compile(
    r"""\s*((["'])(?P<quoted>[^#]+?)\2|(?P<plain>(?!["'])([^\s#]|(?<=\\)\s)+))\s+(?P<tag>[^\s#]+)"""
    r"""(\s+(NONE|RAW|CALIB|PRODUCT))?\s*(#.*)?|\s*(#.*)?""",
    re.IGNORECASE,
)  # the third word is the group of ESO's tools
DARK = "DARK"  # goes to every input; ingest takes the one that fits


def read_sof(path: Path) -> list[Frame]:
    """Read the set of frames at `path`.

    It has lines ``PATH TAG`` or ``PATH TAG GROUP``; ``#`` begins a comment, ``$NAME`` is taken from the
    environment. A path with blanks stands in quotes, or has a backslash before each. Paths count from the
    current folder.

    Raises `InputDataError` when it cannot be read, is empty, or a line has no tag.
    """
    try:
        text = read_regular(path)
    except (OSError, ValueError) as error:
        raise InputDataError(f"{path}: cannot be read: {getattr(error, 'strerror', '') or error}") from error
    frames = []
    for number, line in enumerate(text.splitlines(), 1):
        found = LINE.fullmatch(line)
        if found is None:
            raise InputDataError(
                f"{path}:{number}: expected PATH TAG, found '{printable(line.strip())}'; a path with blanks "
                "stands in quotes"
            )
        if found["tag"]:
            name = found["quoted"] or re.sub(r"\\(\s)", r"\1", found["plain"])
            frames.append((expandvars(name), found["tag"]))
    if not frames:
        raise InputDataError(f"{path}: no frames in it; give lines of PATH TAG")
    return frames


def inputs_from(frames: Sequence[Frame], recipe: str | Path) -> tuple[str, ...]:
    """Return the inputs of a `recipe`, a path or a name, as `load_recipe` takes them: ``NAME=PATH``.

    Raises `ConfigurationError` when the recipe has no input for a tag.
    """
    declared = load_yaml(named_file(recipe, RECIPES))[0].get("inputs")
    names = list(declared) if isinstance(declared, dict) else []
    found: list[str] = []
    for path, tag in frames:
        if tag.upper() == DARK:
            found += [f"{name}={path}" for name in names]
            continue
        wanted = (tag.lower(), *INPUTS_OF.get(tag.upper(), ()))
        name = next((name for name in wanted if name in names), None)
        if name is None:
            known = [*map(str.upper, names), *(one for one, to in INPUTS_OF.items() if set(to) & set(names))]
            raise ConfigurationError(
                f"{path}: recipe '{Path(recipe).stem}' has no input for the tag '{tag}'"
                f"{suggestion(tag, [*known, DARK])}"
            )
        found.append(f"{name}={path}")
    return tuple(found)
