"""The recipes and specifications that come with the package, as text."""

from __future__ import annotations

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import aligned, suggestion
from irlos_pipe.files.shipped import RECIPES, SIMULATIONS, shipped_folder, shipped_names
from irlos_pipe.files.yaml import load_yaml


def recipe_list() -> str:
    """Return a line for every recipe, with its inputs and its title, and one for every specification."""
    recipes, specs = (
        [(name, load_yaml(shipped_folder(kind) / f"{name}.yaml")[0]) for name in shipped_names(kind)]
        for kind in (RECIPES, SIMULATIONS)
    )
    rows = [(name, ", ".join(content["inputs"]), content["title"]) for name, content in recipes]
    simulated = [(name, content["title"]) for name, content in specs]
    return "\n\n".join(
        (
            f"irlos run NAME --input INPUT=PATH --output DIR\n{aligned([('NAME', 'INPUT', ''), *rows])}",
            f"irlos simulate NAME --output DIR\n{aligned([('NAME', ''), *simulated])}",
        )
    )


def recipe_text(name: str) -> str:
    """Return the file of the recipe, or of the specification, called `name`.

    Raises `ConfigurationError` when there is none.
    """
    known = [*shipped_names(RECIPES), *shipped_names(SIMULATIONS)]
    for kind in (RECIPES, SIMULATIONS):
        path = shipped_folder(kind) / f"{name}.yaml"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise ConfigurationError(f"{name}: no recipe or specification of this name{suggestion(name, known)}")
