"""What several commands share."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from irlos_pipe.pipeline import Resources

# Whether a path can be read is told by what reads it, in one line.
FOLDER = click.Path(path_type=Path, readable=False)


def recipe_options(command: Callable) -> Callable:
    """Add the recipe and the options that change it."""
    for decorate in (
        click.option(
            "--seed",
            type=click.IntRange(min=0),
            metavar="N",
            help="Seed of random draws (default: the recipe's).",
        ),
        click.option(
            "--set",
            "settings",
            metavar="STAGE.KEY=VALUE",
            multiple=True,
            help="Change a value of the recipe; VALUE is YAML. May be repeated.",
        ),
        click.option(
            "--input",
            "inputs",
            metavar="NAME=PATH",
            multiple=True,
            help="File or folder for an input of the recipe; a NAME given again makes a list.",
        ),
        click.argument("recipe", type=FOLDER),
    ):
        command = decorate(command)
    return command


def resources_of(device: str, jobs: int | None, quiet: bool) -> Resources:
    """Device, threads and progress bars as the options have them."""
    from irlos_pipe.pipeline import resources

    show_bars = sys.stderr.isatty() and not quiet
    return resources.Resources(
        resources.resolve_device(device),
        jobs or resources.available_cpus(),
        resources.terminal_progress if show_bars else resources.silent_progress,
    )
