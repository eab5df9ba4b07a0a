"""Commands that reduce recordings: run, demo, validate."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeVar

import click

from irlos_pipe.commands import completion
from irlos_pipe.commands.exits import EXIT_CODES, report_error, terminated_like_interrupted
from irlos_pipe.commands.options import FOLDER, JSON, inputs_of, recipe_options, resources_of, setting_options
from irlos_pipe.conventions.errors import ExitCode, IrlosError

if TYPE_CHECKING:
    from irlos_pipe.pipeline import Outcome, Selection
    from irlos_pipe.product.printed import Validation
    from irlos_pipe.recipe import Recipe

Command = TypeVar("Command", bound=Callable)
FORCE = click.option("--force", is_flag=True, help="Run stages even if their products are up to date.")


def _working_options(command: Command) -> Command:
    """Add the options on how a `command` works to it."""
    for decorate in (
        click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors."),
        click.option(
            "-v", "--verbose", count=True, help="Print more messages; -vv prints debugging messages as well."
        ),
        click.option(
            "--device",
            type=click.Choice(["cpu", "cuda", "auto"]),
            default="auto",
            show_default=True,
            help="Processor or graphics card; auto takes the graphics card if there is one.",
        ),
        click.option(
            "--jobs",
            type=click.IntRange(min=1),
            metavar="N",
            help="Number of threads (default: all processors).",
        ),
    ):
        command = decorate(command)
    return command


@click.command(epilog=EXIT_CODES)
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
    shell_complete=completion.completed(completion.stages),
    help="First stage to run; products of earlier stages are used as they are.",
)
@click.option(
    "--to",
    "last",
    metavar="STAGE",
    shell_complete=completion.completed(completion.stages),
    help="Last stage to run; later stages are left alone.",
)
@FORCE
@click.option(
    "--numbered",
    is_flag=True,
    help="Keep every version: DIR/001, DIR/002, ...; DIR/latest links to the newest complete one.",
)
@click.option("--dry-run", is_flag=True, help="Print what would be done and why; change nothing.")
@_working_options
@click.option(
    "--json", "as_json", is_flag=True, help="Print results.json (or the plan) instead of the table."
)
def run(
    recipe: Path,
    output: Path,
    first: str | None,
    last: str | None,
    force: bool,
    numbered: bool,
    dry_run: bool,
    jobs: int | None,
    device: str,
    verbose: int,
    quiet: bool,
    as_json: bool,
    inputs: tuple[str, ...],
    sof: Path | None,
    settings: tuple[str, ...],
    seed: int | None,
    samples: bool,
) -> None:
    """Run the stages of RECIPE and write their products to the folder DIR.

    RECIPE is the path of a recipe, or the name of one that comes with the package (irlos recipes).
    A second run into the same folder skips the products that are up to date, and states why others
    are made again: a setting, an input file, the instrument profile or the software has changed.
    With --numbered no product is ever replaced: where one would be, the run begins a new version
    (irlos status DIR lists them, irlos compare shows how two differ).

    \b
    Examples:
      irlos run full_reduction --input calibration=CUBE --input ramp=RAMP --output full
      irlos run ncpa_calibration --input calibration=2023-07-14 --output night
      irlos run full_reduction --sof night.sof --output full
      irlos run ncpa_calibration --input calibration=2023-07-14 --output night --from correct --dry-run
      irlos run ncpa_calibration --input calibration=2023-07-14 --output reduced --numbered
      irlos run mine/recipe.yaml --input cube=A --input cube=B --output joint
      irlos run ncpa_calibration --samples --output try --set calibrate.method=dip_avg
      irlos run defocus_ramp --samples --output ramp --set model=diagnosis/model.yaml

    \b
    DIR will hold:
      NN_<stage>.h5         product of each stage (irlos show, irlos export)
      results.json          results of all stages, for scripts
      qc.json               quality control
      report.html           report for people
      run.log               messages of all runs into this folder
      recipe.resolved.yaml  the recipe with every default; can be run again
    """
    from irlos_pipe.pipeline import Selection, plan_run
    from irlos_pipe.pipeline.plan import Action
    from irlos_pipe.pipeline.run import version_for
    from irlos_pipe.pipeline.terminal import plan_text
    from irlos_pipe.recipe import load_recipe

    checked = load_recipe(recipe, settings, inputs_of(inputs, sof, recipe), seed, samples=samples)
    selection = Selection(first, last, force)
    if dry_run:
        folder = version_for(checked, output, selection) if numbered else output
        steps = plan_run(checked, folder, selection)[1]
        click.echo(plan_text(steps, as_json))
        _exit_if_any(_problems(checked, [step.name for step in steps if step.action is Action.RUN]))
        return
    outcome = _outcome(checked, output, selection, device, jobs, verbose, quiet, numbered=numbered)
    _print(outcome, as_json, quiet)
    _finish(outcome)


@click.command(epilog=EXIT_CODES)
@click.option(
    "--output",
    type=FOLDER,
    default=Path("demo"),
    show_default=True,
    metavar="DIR",
    help="Folder for the products; it is made if it does not exist.",
)
@setting_options
@FORCE
@_working_options
def demo(
    output: Path,
    settings: tuple[str, ...],
    seed: int | None,
    force: bool,
    jobs: int | None,
    device: str,
    verbose: int,
    quiet: bool,
) -> None:
    """Reduce the sample recordings of the package and compare the result with the known truth.

    The recordings, a calibration cube and a focus ramp, are simulated. This is
    irlos run full_reduction --samples, followed by irlos score.

    \b
    Example:
      irlos demo --output demo
    """
    from irlos_pipe.files.shipped import SAMPLES, shipped_folder
    from irlos_pipe.pipeline import Selection
    from irlos_pipe.recipe import load_recipe
    from irlos_pipe.report.score import score_run, score_text

    checked = load_recipe("full_reduction", settings, seed=seed, samples=True)
    outcome = _outcome(checked, output, Selection(force=force), device, jobs, verbose, quiet)
    _print(outcome, False, quiet)
    if not quiet:
        click.echo(f"\n{score_text(score_run(output, shipped_folder(SAMPLES) / 'truth'))}")
    _finish(outcome)


@click.command(epilog=EXIT_CODES)
@recipe_options
@JSON
def validate(
    recipe: Path,
    inputs: tuple[str, ...],
    sof: Path | None,
    settings: tuple[str, ...],
    seed: int | None,
    samples: bool,
    as_json: bool,
) -> None:
    """Check RECIPE, its options and its inputs without running anything.

    All errors are reported at once, each as file:line: message (or --set KEY: message): first those of
    the recipe, then those of the recordings and their side-cars. Inputs that are not given are left out.

    \b
    Examples:
      irlos validate full_reduction
      irlos validate ncpa_calibration --input calibration=2023-07-14
      irlos validate mine/recipe.yaml --json
    """
    from irlos_pipe.product.printed import Validation
    from irlos_pipe.recipe import load_recipe

    try:
        given = inputs_of(inputs, sof, recipe)
        checked = load_recipe(recipe, settings, given, seed, samples=samples, complete=False)
        problems = _problems(checked)
    except IrlosError as error:
        if as_json:
            click.echo(Validation(recipe=str(recipe), problems=str(error).splitlines()).text())
        raise
    if as_json:
        click.echo(_validation(recipe, checked, problems).text())
    _exit_if_any(problems)
    if not as_json:
        open_inputs = [name for name, paths in checked.inputs.items() if not paths]
        rest = f"; to be given: {', '.join(open_inputs)}" if open_inputs else ""
        click.echo(f"{recipe}: recipe '{checked.name}' is valid: {', '.join(checked.stages)}{rest}")


def _validation(recipe: Path, checked: Recipe, problems: list[str]) -> Validation:
    from irlos_pipe.product.printed import Validation

    return Validation(
        recipe=str(recipe),
        valid=not problems,
        name=checked.name,
        stages=list(checked.stages),
        inputs={name: [str(path) for path in paths] for name, paths in checked.inputs.items()},
        problems=problems,
    )


def _outcome(
    recipe: Recipe,
    output: Path,
    selection: Selection,
    device: str,
    jobs: int | None,
    verbose: int,
    quiet: bool,
    *,
    numbered: bool = False,
) -> Outcome:
    """Run a recipe with messages and progress bars as asked for."""
    from irlos_pipe.pipeline import run_recipe
    from irlos_pipe.pipeline.run import run_numbered
    from irlos_pipe.pipeline.terminal import messages

    if verbose and quiet:
        raise click.UsageError("-v and -q exclude each other")
    with terminated_like_interrupted(), messages(-1 if quiet else verbose):
        reduce = run_numbered if numbered else run_recipe
        return reduce(recipe, output, selection, resources_of(device, jobs, quiet))


def _problems(recipe: Recipe, stages: Collection[str] | None = None) -> list[str]:
    """All that is wrong with the recordings that stages of a recipe, by default all, would read."""
    if not any(recipe.inputs.values()):
        return []
    from irlos_pipe.pipeline.plan import input_problems
    from irlos_pipe.pipeline.terminal import messages

    with messages(0):
        return input_problems(recipe, stages)


def _exit_if_any(problems: list[str]) -> None:
    """Report what is wrong, if anything is, and exit."""
    for line in problems:
        report_error(line)
    if problems:
        sys.exit(ExitCode.BAD_DATA)


def _print(outcome: Outcome, as_json: bool, quiet: bool) -> None:
    from irlos_pipe.pipeline.terminal import outcome_text

    if as_json or not quiet:
        click.echo(outcome_text(outcome, as_json))


def _finish(outcome: Outcome) -> NoReturn:
    """Exit with the code of the outcome."""
    if outcome.report_error:
        report_error(outcome.report_error)
    sys.exit(outcome.exit_code)
