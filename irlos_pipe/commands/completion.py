"""What the shell proposes for arguments and options: names of recipes, stages, inputs, keys, arrays."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from irlos_pipe.conventions.errors import IrlosError

Completion = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]


def _proposed(names: Callable[[click.Context], Iterable[str]]) -> Completion:
    """Propose what `names` returns."""

    def propose(context: click.Context, parameter: click.Parameter, begun: str) -> list[CompletionItem]:
        with suppress(IrlosError, OSError):  # no error while somebody types
            return [CompletionItem(name) for name in names(context) if name.startswith(begun)]
        return []

    return propose


def or_files(propose: Completion) -> Completion:
    """Propose files as well."""
    return lambda *asked: [*propose(*asked), CompletionItem(asked[2], type="file")]


@_proposed
def recipes(context: click.Context) -> Iterable[str]:
    from irlos_pipe.files.shipped import RECIPES, shipped_names

    return shipped_names(RECIPES)


@_proposed
def specifications(context: click.Context) -> Iterable[str]:
    from irlos_pipe.files.shipped import SIMULATIONS, shipped_names

    return shipped_names(SIMULATIONS)


@_proposed
def stages(context: click.Context) -> Iterable[str]:
    """Stages of the recipe that was typed."""
    return _recipe(context).get("stages", ())


@_proposed
def inputs(context: click.Context) -> Iterable[str]:
    """``NAME=`` for the inputs of the recipe that was typed."""
    return [f"{name}=" for name in _recipe(context).get("inputs", ())]


@_proposed
def settings(context: click.Context) -> Iterable[str]:
    """``STAGE.KEY=`` for the settings of the recipe that was typed."""
    from irlos_pipe.reference.lookup import key_entries

    sections = ("model", *_recipe(context).get("stages", ()))
    return [f"{one.name}=" for one in key_entries() if one.name.partition(".")[0] in sections]


@_proposed
def explained(context: click.Context) -> Iterable[str]:
    from irlos_pipe.reference.lookup import all_entries

    return sorted({entry.name for entry in all_entries()})


@_proposed
def arrays(context: click.Context) -> Iterable[str]:
    """Names of the arrays of the product that was typed."""
    from irlos_pipe.product.storage import read_product

    return read_product(Path(_typed(context, "product") or "")).arrays


def _typed(context: click.Context, argument: str) -> str | None:
    """The `argument` of a command; click leaves it unread behind an option that still lacks its value."""
    return context.params.get(argument) or next(iter(context.args), None)


def _recipe(context: click.Context) -> dict:
    return content_of(_typed(context, "recipe"))


def content_of(recipe: str | None) -> dict:
    """Return what the file of a `recipe`, a name or a path, holds."""
    from irlos_pipe.files.shipped import RECIPES, named_file
    from irlos_pipe.files.yaml import load_yaml

    return load_yaml(named_file(recipe or "full_reduction", RECIPES))[0]
