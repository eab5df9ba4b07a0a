"""The command line of a command is the signature of its function; parameters that several commands share.

``output: Path = option("--output DIR", "Folder for …")`` is an option, spelt as in the help. Its type says
the rest: a bool is a flag, a tuple may be given again, what may be None need not be given.
"""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

import click

from irlos_pipe.commands import completion

if TYPE_CHECKING:
    from irlos_pipe.pipeline import Resources

Device = Literal["cpu", "cuda", "auto"]


class _NamedPath(click.Path):
    """A path that is given and can be shown: that of an unset variable would be the current folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not os.fspath(value):
            self.fail("an empty name; give a path", param, ctx)
        if not os.fsdecode(value).isprintable():
            self.fail(f"{os.fsdecode(value)!r} holds characters that cannot be shown; rename it", param, ctx)
        return super().convert(value, param, ctx)


# Whether a path can be read is reported, in one line, by the code that reads it.
PATH = _NamedPath(path_type=Path, readable=False)


def option(spelling: str, help: str, **settings: Any) -> Any:
    """Return the default of a parameter that is an option: it makes that of the parameter's name and type.

    The `spelling` is that in the help, ``-q, --quiet`` or ``--output DIR``; `settings` are those of
    `click.Option` beyond what the type of the parameter says.
    """
    names = [word.rstrip(",") for word in spelling.split() if word.startswith("-")]
    metavar = " ".join(word for word in spelling.split() if not word.startswith("-")) or None

    def make(name: str, kind: Any) -> click.Parameter:
        derived: dict[str, Any] = {"metavar": metavar, "help": help, "show_default": "default" in settings}
        if kind is bool:
            derived["is_flag"] = True
        elif "count" not in settings:
            many, optional = get_origin(kind) is tuple, type(None) in get_args(kind)
            required = not many and not optional and "default" not in settings
            derived |= {"type": _type_of(kind), "multiple": many, "required": required}
        return click.Option([name, *names], **derived | settings)

    return make


def argument(metavar: str | None = None, **settings: Any) -> Any:
    """The same for an argument, called `metavar` in the help, with `settings` of `click.Argument`."""

    def make(name: str, kind: Any) -> click.Parameter:
        derived = {"metavar": metavar, "type": _type_of(kind), "required": type(None) not in get_args(kind)}
        return click.Argument([name], **derived | settings)

    return make


def _type_of(kind: Any) -> Any:
    """What click makes of a value: of ``Path | None``, ``tuple[str, ...]`` or ``Literal["a", "b"]``."""
    if get_origin(kind) is Literal:
        return click.Choice(get_args(kind))
    inner = [one for one in get_args(kind) if one not in (type(None), ...)]
    return _type_of(inner[0]) if inner else PATH if kind is Path else kind


class OfRecipe(click.Command):
    """A command whose files are options: of one that stands behind RECIPE it says which."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        given = list(args)
        try:
            return super().parse_args(ctx, args)
        except click.UsageError:
            values, left, _ = self.make_parser(ctx).parse_args(given)
            if left:
                names = completion.content_of(values["recipe"]).get("inputs") or ("NAME",)
                ways = [f"--input {name}={left[0]}" for name in names]
                ctx.fail(f"'{left[0]}': files are given by the name of their input: {' or '.join(ways)}")
            raise


def command(*more: type, **settings: Any) -> Callable[[Callable[..., None]], click.Command]:
    """Make a command of a function; fields of the dataclasses `more` are options, too."""

    def make(function: Callable[..., None]) -> click.Command:
        parts: list[Callable[..., Any]] = [function, *more]
        params = [
            parameter.default(name, get_type_hints(part)[name])
            for part in parts
            for name, parameter in inspect.signature(part).parameters.items()
            if parameter.default is not parameter.empty
        ]
        return click.command(params=params, **settings)(function)

    return make


RECIPE = argument(shell_complete=completion.or_files(completion.recipes))
INPUTS = option(
    "--input NAME=PATH",
    "File or folder for an input of the recipe. A NAME given again makes a list.",
    shell_complete=completion.inputs,
)
SOF = option(
    "--sof FILE", "Set of frames: a text file with PATH TAG in every line, beside or instead of --input."
)
SAMPLES = option(
    "--samples", "Take the simulated sample recordings of the package for inputs that are not given."
)
SETTINGS = option(
    "--set STAGE.KEY=VALUE",
    "Change a value of the recipe; VALUE is YAML. May be repeated.",
    shell_complete=completion.settings,
)
FROM_0, FROM_1 = click.IntRange(min=0), click.IntRange(min=1)
SEED = option("--seed N", "Seed of the random numbers (default: that of the recipe).", type=FROM_0)
OUTPUT = ("--output DIR", "Folder for the products; it is made if it does not exist.")
AGAIN = option("--force", "Run stages even if their products are up to date.")
REPLACE = option("--force", "Replace FILE if it exists.")
DRY_RUN = option("--dry-run", "Print what would be done and why; change nothing.")
THREADS = option("--jobs N", "Number of workers (default: all processors).", type=FROM_1)
PROCESSES = option("--jobs N", "Number of processes (default: all processors).", type=FROM_1)
DEVICE = ("--device", "Processor or graphics card; auto takes the graphics card if there is one.")
VERBOSE = option("-v, --verbose", "Print more messages; -vv prints debugging messages as well.", count=True)
QUIET = option("-q, --quiet", "Print nothing but errors.")
JSON = option("--json", "Print JSON, for scripts (irlos explain --schema commands).")


def inputs_of(inputs: tuple[str, ...], sof: Path | None, recipe: Path) -> tuple[str, ...]:
    """Return the `inputs` of a `recipe`, ``NAME=PATH``, and behind them those of a set of frames, `sof`."""
    if sof is None:
        return inputs
    from irlos_pipe.recipe.sof import inputs_from, read_sof

    return (*inputs, *inputs_from(read_sof(sof), recipe))


@contextmanager
def at_work(verbose: int, quiet: bool) -> Iterator[None]:
    """Show as many messages as `verbose` and `quiet` ask for."""
    from irlos_pipe.pipeline.terminal import messages

    if verbose and quiet:
        raise click.UsageError("-v and -q exclude each other")
    with messages(-1 if quiet else verbose):
        yield


def resources_of(device: str, jobs: int | None, quiet: bool) -> Resources:
    """Return the resources that the options state; all processors without `jobs`.

    It is an error at once that there is no ``cuda``; what ``auto`` means is seen when a stage runs. `quiet`
    shows no progress; where stderr is not a terminal it is logged.
    """
    from irlos_pipe.pipeline import resources

    if device == "cuda":
        resources.resolve_device(device)
    seen = resources.terminal_progress if sys.stderr.isatty() else resources.logged_progress
    progress = resources.silent_progress if quiet else seen
    return resources.Resources(device, jobs or resources.available_cpus(), progress)
