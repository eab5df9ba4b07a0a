"""Options that several commands share."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from irlos_pipe.commands import completion

if TYPE_CHECKING:
    from irlos_pipe.pipeline import Resources

# Whether a path can be read is reported, in one line, by the code that reads it.
Command = TypeVar("Command", bound=Callable[..., Any])


class _NamedPath(click.Path):
    """A path that is given and can be shown: that of an unset variable would be the current folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not os.fspath(value):
            self.fail("an empty name; give a path", param, ctx)
        if not os.fsdecode(value).isprintable():
            self.fail(f"{os.fsdecode(value)!r} holds characters that cannot be shown; rename it", param, ctx)
        return super().convert(value, param, ctx)


FOLDER = _NamedPath(path_type=Path, readable=False)
JSON = click.option(
    "--json", "as_json", is_flag=True, help="Print JSON, for scripts (irlos explain --schema commands)."
)


def setting_options(command: Command) -> Command:
    """Add the options that change values of a recipe to a `command`."""
    for decorate in (
        click.option(
            "--seed",
            type=click.IntRange(min=0),
            metavar="N",
            help="Seed of the random numbers (default: that of the recipe).",
        ),
        click.option(
            "--set",
            "settings",
            metavar="STAGE.KEY=VALUE",
            multiple=True,
            help="Change a value of the recipe; VALUE is YAML. May be repeated.",
            shell_complete=completion.completed(completion.settings),
        ),
    ):
        command = decorate(command)
    return command


def recipe_options(command: Command) -> Command:
    """Add the argument RECIPE and the options that change it to a `command`."""
    for decorate in (
        setting_options,
        click.option(
            "--samples",
            is_flag=True,
            help="Take the simulated sample recordings of the package for inputs that are not given.",
        ),
        click.option(
            "--sof",
            type=FOLDER,
            metavar="FILE",
            help="Set of frames: a text file with PATH TAG in every line, beside or instead of --input.",
        ),
        click.option(
            "--input",
            "inputs",
            metavar="NAME=PATH",
            multiple=True,
            help="File or folder for an input of the recipe. A NAME given again makes a list.",
            shell_complete=completion.completed(completion.inputs),
        ),
        click.argument(
            "recipe",
            type=FOLDER,
            shell_complete=completion.completed(completion.recipes, files=True),
        ),
    ):
        command = decorate(command)
    return command


def inputs_of(inputs: tuple[str, ...], sof: Path | None, recipe: Path) -> tuple[str, ...]:
    """Return the inputs of a recipe, those of a set of frames behind the others.

    Parameters
    ----------
    inputs : tuple of str
        ``NAME=PATH``.
    sof : Path or None
        The set of frames, if there is one.
    recipe : Path
        Path or name.
    """
    if sof is None:
        return inputs
    from irlos_pipe.recipe.sof import inputs_from, read_sof

    return (*inputs, *inputs_from(read_sof(sof), recipe))


def resources_of(device: str, jobs: int | None, quiet: bool) -> Resources:
    """Return the resources that the options state.

    Parameters
    ----------
    device : {"cpu", "cuda", "auto"}
        It is an error at once that there is no ``cuda``; what ``auto`` means is seen when a stage runs.
    jobs : int or None
        Threads or processes; None for all processors.
    quiet : bool
        Show no progress bars, as when stderr is not a terminal.
    """
    from irlos_pipe.pipeline import resources

    if device == "cuda":
        resources.resolve_device(device)
    show_bars = sys.stderr.isatty() and not quiet
    return resources.Resources(
        device,
        jobs or resources.available_cpus(),
        resources.terminal_progress if show_bars else resources.silent_progress,
    )
