"""What is wrong with a scene, in one line."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

from irlos_pipe.conventions.errors import ConfigurationError


class SceneError(ConfigurationError, ValueError):
    """A scene that cannot be simulated."""


def require_known(where: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Refuse names that are not known, and suggest the nearest.

    Raises
    ------
    SceneError
    """
    known = list(known)
    for name in names:
        if name not in known:
            near = get_close_matches(str(name), known, n=1, cutoff=0.5)
            hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}"
            raise SceneError(f"{where}: '{name}' is not known; {hint}")
