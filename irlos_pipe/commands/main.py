"""The commands: each parses its options, calls the work and ends with its exit code."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

import irlos_pipe
from irlos_pipe.commands.exits import EXIT_CODES, IrlosGroup, report_error, terminated_like_interrupted
from irlos_pipe.commands.night import night, trend
from irlos_pipe.commands.options import FOLDER, recipe_options, resources_of
from irlos_pipe.commands.products import export, report, score, show, status
from irlos_pipe.commands.simulated import paper, simulate

# Commands import what they need when they run: the help should not wait for PyTorch.
if TYPE_CHECKING:
    from irlos_pipe.pipeline import Outcome


@click.group(cls=IrlosGroup, epilog=EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(irlos_pipe.__version__, prog_name="irlos")
def cli() -> None:
    """Measure NCPAs and defocus on recordings of the IRLOS low-order sensor.

    \b
    Start here:
      irlos validate recipes/full_reduction.yaml
      irlos run recipes/full_reduction.yaml --output demo
      irlos status demo
      irlos show demo/03_calibrate.h5

    irlos COMMAND --help explains each command.
    """


@cli.command(epilog=EXIT_CODES)
@recipe_options
@click.option(
    "--output",
    type=FOLDER,
    required=True,
    metavar="DIR",
    help="Folder for the products; it is made if it does not exist.",
)
@click.option(
    "--from",
    "first",
    metavar="STAGE",
    help="First stage to run; products of earlier stages are used as they are.",
)
@click.option("--to", "last", metavar="STAGE", help="Last stage to run; later stages are left alone.")
@click.option("--force", is_flag=True, help="Run stages even if their products are up to date.")
@click.option("--dry-run", is_flag=True, help="Print what would be done and why; change nothing.")
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N", help="Number of threads (default: all processors)."
)
@click.option(
    "--device",
    type=click.Choice(["cpu", "cuda", "auto"]),
    default="auto",
    show_default=True,
    help="Processor or graphics card; auto takes the graphics card if there is one.",
)
@click.option(
    "-v", "--verbose", count=True, help="Print more messages; -vv prints debugging messages as well."
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
@click.option(
    "--json", "as_json", is_flag=True, help="Print results.json (or the plan) instead of the table."
)
def run(
    recipe: Path,
    output: Path,
    first: str | None,
    last: str | None,
    force: bool,
    dry_run: bool,
    jobs: int | None,
    device: str,
    verbose: int,
    quiet: bool,
    as_json: bool,
    inputs: tuple[str, ...],
    settings: tuple[str, ...],
    seed: int | None,
) -> None:
    """Run the stages of RECIPE and write their products to the folder DIR.

    A second run into the same folder skips the products that are up to date, and states why others
    are made again: a setting, an input file, the instrument profile or the software has changed.

    \b
    Examples:
      irlos run recipes/full_reduction.yaml --output demo
      irlos run recipes/ncpa_calibration.yaml --input calibration=2023-07-14 --output night
      irlos run recipes/ncpa_calibration.yaml --output night --set calibrate.method=dip_avg
      irlos run recipes/ncpa_calibration.yaml --output night --from correct --dry-run
      irlos run recipes/defocus_ramp.yaml --output ramp --set model.effects='[seeing_halo]'
      irlos run recipes/defocus_ramp.yaml --output ramp --set model=diagnosis/model.yaml

    \b
    DIR will hold:
      NN_<stage>.h5         product of each stage (irlos show, irlos export)
      results.json          results of all stages, for scripts
      qc.json               quality control
      report.html           report for people
      run.log               messages of all runs into this folder
      recipe.resolved.yaml  the recipe with every default; can be run again
    """
    from irlos_pipe.pipeline import Selection, plan_run, run_recipe
    from irlos_pipe.pipeline.terminal import messages, plan_text
    from irlos_pipe.recipe import load_recipe

    if verbose and quiet:
        raise click.UsageError("-v and -q exclude each other")
    checked = load_recipe(recipe, settings, inputs, seed)
    selection = Selection(first, last, force)
    if dry_run:
        click.echo(plan_text(plan_run(checked, output, selection)[1], as_json))
        return
    with terminated_like_interrupted(), messages(-1 if quiet else verbose):
        outcome = run_recipe(checked, output, selection, resources_of(device, jobs, quiet))
    _finish(outcome, as_json, quiet)


@cli.command()
@recipe_options
def validate(recipe: Path, inputs: tuple[str, ...], settings: tuple[str, ...], seed: int | None) -> None:
    """Check RECIPE, its options and its inputs without running anything.

    All errors are reported at once, each as file:line: message (or --set KEY: message).

    \b
    Examples:
      irlos validate recipes/full_reduction.yaml
      irlos validate recipes/ncpa_calibration.yaml --input calibration=2023-07-14
    """
    from irlos_pipe.recipe import load_recipe

    checked = load_recipe(recipe, settings, inputs, seed)
    click.echo(f"{recipe}: recipe '{checked.name}' is valid: {', '.join(checked.stages)}")


def _finish(outcome: Outcome, as_json: bool, quiet: bool) -> NoReturn:
    """Print the result and exit with its code."""
    from irlos_pipe.pipeline.terminal import outcome_text

    if as_json or not quiet:
        click.echo(outcome_text(outcome, as_json))
    if outcome.report_error:
        report_error(outcome.report_error)
    sys.exit(outcome.exit_code)


for command in (status, show, report, export, score, simulate, paper, night, trend):
    cli.add_command(command)
