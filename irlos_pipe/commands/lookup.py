"""Commands that look things up: recipes, explain, sidecar."""

import os
from pathlib import Path
from typing import Literal

import click

from irlos_pipe.commands import completion, options
from irlos_pipe.commands.options import argument, command, option


@command()
def recipes(
    name: str | None = argument(shell_complete=completion.recipes),
) -> None:
    """List the recipes and specifications that come with the package, or print the one called NAME.

    \b
    Examples:
      irlos recipes
      irlos recipes ncpa_calibration > mine.yaml
      irlos recipes on_sky > night.yaml
    """
    from irlos_pipe.reference.lookup import recipe_list, recipe_text

    click.echo(recipe_list() if name is None else recipe_text(name), nl=name is None)


@command()
def explain(
    name: str | None = argument(shell_complete=completion.explained),
    schema: Literal["results", "commands"] | None = option(
        "--schema",
        "Print the JSON Schema of results.json, or of what commands print with --json.",
        is_flag=False,
        flag_value="results",
    ),
) -> None:
    """Explain a stage, key, effect, check, array of a product, number of results.json, or term.

    NAME is the whole name, or the last part of it. Without it, stages, effects and checks are listed.
    Keys are those of recipes, side-cars and instrument profiles.

    \b
    Examples:
      irlos explain calibrate
      irlos explain calibrate.highest_noll
      irlos explain seeing_halo
      irlos explain 'twin solution'
      irlos explain chi2_nu
      irlos explain gap
      irlos explain --schema > results.schema.json
      irlos explain --schema commands > commands.schema.json
    """
    if schema:
        from irlos_pipe.reference import FILES

        click.echo(FILES[schema].read_text(encoding="utf-8"), nl=False)
        return
    from irlos_pipe.reference.lookup import explain as explanation
    from irlos_pipe.reference.lookup import overview

    click.echo(overview() if name is None else explanation(name))


@command()
def sidecar(
    fits: Path = argument("FITS"),
    instrument: str | None = option(
        "--instrument NAME",
        "Instrument profile, which the side-car will state: a name, or the path of a YAML file "
        "(default: irlos).",
    ),
    output: Path | None = option(
        "--output FILE",
        "File to write (default: where it is looked for beside FITS); - writes it to the terminal.",
    ),
    force: bool = options.REPLACE,
) -> None:
    """Write a side-car for the recording in FITS, with comments and what the header says, to be filled in.

    A side-car states what the data cannot say: instrument, role, spectrum, diversity. irlos validate
    checks it, and irlos show FITS says what can be done with the recording.

    \b
    Examples:
      irlos sidecar star.fits --instrument cam42.yaml
      irlos sidecar 2023-07-14/2023-07-14.fits --output -
    """
    from irlos_pipe.instrument.instrument import is_path, load_instrument
    from irlos_pipe.readers.sidecar_template import sidecar_template, write_template

    stated = instrument or ""
    if is_path(stated):
        stated = os.path.relpath(stated, (output or fits).parent)
    text = sidecar_template(fits, load_instrument(instrument or "irlos"), stated)
    if str(output) == "-":
        click.echo(text, nl=False)
        return
    click.echo(write_template(text, fits, output, replace=force))
