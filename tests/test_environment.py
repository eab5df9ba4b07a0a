"""The environment that is built: every direct dependency pinned, and PyTorch's index for PyTorch alone."""

import re
import tomllib

from helpers.paths import REPOSITORY

NAME = re.compile(r"[A-Za-z0-9_.-]+")
FOREIGN = "esorex"  # extra whose packages are on an index of their own


def direct_dependencies() -> set[str]:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = [lines for name, lines in project["optional-dependencies"].items() if name != FOREIGN]
    lines = [line for some in (project["dependencies"], *extras) for line in some]
    return {NAME.match(line)[0] for line in lines} - {project["name"]}


def test_every_direct_dependency_is_pinned():
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    pinned = [line.split("==")[0] for line in lines if not line.startswith("#")]
    assert set(pinned) == direct_dependencies() and len(pinned) == len(set(pinned))
    assert all(re.fullmatch(r"[\w.-]+==[\d.]+(post\d+)?", line) for line in lines if not line.startswith("#"))
