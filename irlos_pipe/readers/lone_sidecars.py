"""Side-cars whose recording is not there: lost, renamed, or still under way."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import get_args

from irlos_pipe.conventions.text import printable
from irlos_pipe.files.regular import open_regular
from irlos_pipe.readers.fitsfile import stem
from irlos_pipe.readers.sidecar import FOLDER_SIDECAR, Role

# What tells a side-car from recipes, profiles and other YAML files: the key that each must have.
ROLE = re.compile(rf"^role[ \t]*:[ \t]*['\"]?({'|'.join(get_args(Role))})\b".encode(), re.MULTILINE)
LOOKED_AT_BYTES = 2**16
SHOWN_NAMES = 3


def is_sidecar(path: Path) -> bool:
    """Return whether a file is a side-car, by its name or by what it holds."""
    if path.suffix != ".yaml" or not path.is_file():
        return False
    if path.name == FOLDER_SIDECAR:
        return True
    try:
        with open_regular(path) as stream:
            return ROLE.search(stream.read(LOOKED_AT_BYTES)) is not None
    except OSError:
        return False


def lone_sidecars(sidecars: Sequence[Path], named: Sequence[Path], with_data: Collection[Path]) -> list[Path]:
    """Return the side-cars of a folder that describe nothing.

    Parameters
    ----------
    sidecars : sequence of Path
        YAML files of the folder.
    named : sequence of Path
        Its files that are named like FITS files.
    with_data : collection of Path
        Folders that hold a recording, in them or below.
    """
    stems = {stem(file) for file in named}
    return [
        path
        for path in sidecars
        if (path.parent not in with_data if path.name == FOLDER_SIDECAR else path.stem not in stems)
        and is_sidecar(path)
    ]


def what_lies_beside(sidecar: Path) -> str:
    """Return a line that says that a side-car is no recording, and what lies beside it."""
    own = sidecar.parent.name if sidecar.name == FOLDER_SIDECAR else sidecar.stem
    others = sorted(one.name for one in sidecar.parent.iterdir() if one != sidecar and one.name[0] != ".")
    names = [name for name in others if name.startswith(own)] or others
    more = f" and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    beside = (
        f"beside it: {printable(', '.join(names[:SHOWN_NAMES]))}{more}" if names else "nothing lies beside it"
    )
    return (
        f"{sidecar}: a side-car, and no recording that could be read belongs to it; {beside}; "
        "complete the recording, or remove the side-car"
    )
