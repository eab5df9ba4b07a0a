"""From groups to tasks: which recipe runs on which recordings, and where its products go."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.json import jsonable
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.night.grouping import Group
from irlos_pipe.night.settings import NightSettings
from irlos_pipe.recipe import Recipe, load_recipe


@dataclass(frozen=True)
class Task:
    """A recipe and the recordings to run it on: small, and the same in any process on any machine.

    Attributes
    ----------
    name : str
        ``<night>/<group>/<recipe>``, unique in the tree.
    folder : Path
        Where the products are found when they are complete, see `PublishedRun`.
    recipe, settings, inputs :
        Arguments of `load_recipe`.
    device : str
        ``cpu``, ``cuda`` or ``auto``.
    threads : int
        Threads of the process that works on it; results do not depend on it.
    limit_s : float
        Longest time that it may take [s]; no limit if 0.
    """

    name: str
    folder: Path
    recipe: Path
    settings: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    device: str = "cpu"
    threads: int = 1
    limit_s: float = 0.0

    def load(self) -> Recipe:
        """Return the validated recipe.

        Raises
        ------
        ConfigurationError
            When it is not valid.
        """
        return load_recipe(self.recipe, self.settings, self.inputs)


@dataclass(frozen=True)
class Job:
    """A task and the group whose recordings it reduces."""

    group: Group
    task: Task


def jobs_of(groups: Iterable[Group], settings: NightSettings, tree: Path, device: str = "cpu") -> list[Job]:
    """Return one job per group and recipe, whether or not its products are up to date.

    Parameters
    ----------
    groups : iterable of Group
        Recordings that are reduced together.
    settings : NightSettings
        Recipes by kind of group, and changes of their settings.
    tree : Path
        Products go to ``tree/<night>/<group>/<recipe>``.
    device : str
        ``cpu``, ``cuda`` or ``auto``.

    Raises
    ------
    ConfigurationError
        When a recipe is not valid, or declares an input that its kind of group does not have.
    """
    tree = tree.absolute()  # tasks may be worked on elsewhere
    jobs = [Job(group, task) for group in groups for task in _tasks(group, settings, tree, device)]
    for job in {job.task.recipe: job for job in jobs}.values():
        job.task.load()
    return jobs


def _tasks(group: Group, settings: NightSettings, tree: Path, device: str) -> Iterator[Task]:
    for recipe in settings.recipes_of(group.kind):
        name = f"{group.night}/{group.name}/{recipe.stem}"
        yield Task(
            name,
            tree / name,
            recipe,
            _settings(recipe, settings),
            _inputs(recipe, group),
            device,
            limit_s=60 * settings.limit_min,
        )


def calibrates(recipe: Path) -> bool:
    """Return whether a `recipe` has the stage `calibrate`, whose quality a calibration is judged by."""
    return "calibrate" in (load_yaml(recipe)[0].get("stages") or ())


def _inputs(recipe: Path, group: Group) -> tuple[str, ...]:
    """``NAME=PATH`` for every input of the recipe."""
    declared = load_yaml(recipe)[0].get("inputs")
    names = list(declared) if isinstance(declared, dict) else []
    for name in names:
        if name not in group.inputs:
            offered = " and ".join(f"'{one}'" for one in group.inputs)
            raise ConfigurationError(
                f"{recipe}: needs input '{name}', but a group of kind '{group.kind}' has only "
                f"{offered}; choose another recipe with --recipe {group.kind}=PATH"
            )
    return tuple(f"{name}={recording.path}" for name in names for recording in group.inputs[name])


def _settings(recipe: Path, settings: NightSettings) -> tuple[str, ...]:
    """``stage.key=VALUE`` for every setting of the recipe that is changed."""
    changed = dict(settings.settings.get(recipe.stem, {}))
    keys = settings.acquisition.model_dump(mode="json", exclude_none=True)
    if keys:
        changed["ingest.acquisition"] = keys
    return tuple(f"{key}={json.dumps(jsonable(value))}" for key, value in changed.items())
