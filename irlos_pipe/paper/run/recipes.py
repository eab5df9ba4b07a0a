"""Which experiments there are: the recipes of a folder, in the order of the paper."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.recipe import Recipe, load_recipe
from irlos_pipe.stages import STAGES

QUICK_NAME = "quick.yaml"


@dataclass(frozen=True)
class Experiment:
    """A recipe and the name of its file and folder; one not `wanted` is shown only when it is up to date."""

    name: str
    recipe: Recipe
    wanted: bool = True


def find_experiments(
    folder: Path, *, quick: bool = False, only: Collection[str] = (), seed: int | None = None
) -> list[Experiment]:
    """Load the recipes of a folder, in the order in which the package lists their last stages.

    With `quick` they are changed as ``quick.yaml`` next to them says: ``{recipe: {stage.key: value}}``.
    `only` names those to run, all if empty; others that are not valid are left out. A `seed` replaces that of
    every recipe.

    Raises `ConfigurationError` when there are no recipes, one of those to run is not valid, or a name is
    unknown.
    """
    paths = {path.stem: path for path in sorted(folder.glob("*.yaml")) if path.name != QUICK_NAME}
    if not paths:
        raise ConfigurationError(
            f"--recipes {folder}: no recipes there; give a folder of recipes, or leave the option out"
        )
    for name in only:
        if name not in paths:
            raise ConfigurationError(f"--only {name}: no such experiment{suggestion(name, paths)}")
    changes = _quick_changes(folder / QUICK_NAME, paths) if quick else {}
    found = []
    for name, path in paths.items():
        settings = [f"{key}={json.dumps(value)}" for key, value in changes.get(name, {}).items()]
        wanted = not only or name in only
        try:
            found.append(Experiment(name, load_recipe(path, settings, seed=seed), wanted))
        except ConfigurationError as error:
            if wanted:
                # The recipe reports them as options of the command line; they stand in this file.
                text = str(error).replace("--set ", f"{folder / QUICK_NAME}: ")
                raise ConfigurationError(text) from error
    return sorted(found, key=lambda one: list(STAGES).index(one.recipe.stages[-1]))


def _quick_changes(path: Path, known: Collection[str]) -> Mapping[str, Mapping[str, Any]]:
    changes, lines = load_yaml(path)
    for name, settings in changes.items():
        where = f"{path}:{lines[name,]}"
        if name not in known:
            raise ConfigurationError(f"{where}: no recipe '{name}'{suggestion(name, known)}")
        if not isinstance(settings, dict):
            raise ConfigurationError(f"{where}: '{name}' should be a section of 'stage.key: value' lines")
    return changes
