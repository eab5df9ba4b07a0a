"""Simulated scenes, in memory. They share no line of optics with the model that is fitted to their images."""

from collections.abc import Iterable

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion


class SceneError(ConfigurationError, ValueError):
    """A scene that cannot be simulated."""


def require_known(where: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Refuse `names`, given as `where`, that are not `known`, by a `SceneError` with the nearest name."""
    known = list(known)
    for name in names:
        if name not in known:
            raise SceneError(f"{where}: '{name}' is not known{suggestion(name, known)}")
