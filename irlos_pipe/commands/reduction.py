"""Commands that reduce recordings: run, demo, validate."""

from __future__ import annotations

import sys
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from irlos_pipe.commands import completion, options
from irlos_pipe.commands.exits import SEE_EXIT_CODES, report_error
from irlos_pipe.commands.options import (
    Device,
    argument,
    at_work,
    command,
    inputs_of,
    option,
    resources_of,
)
from irlos_pipe.conventions.errors import ExitCode, IrlosError

if TYPE_CHECKING:
    from irlos_pipe.pipeline import Outcome
    from irlos_pipe.recipe import Recipe


@command(cls=options.OfRecipe, epilog=SEE_EXIT_CODES)
def run(
    recipe: Path = options.RECIPE,
    inputs: tuple[str, ...] = options.INPUTS,
    sof: Path | None = options.SOF,
    samples: bool = options.SAMPLES,
    settings: tuple[str, ...] = options.SETTINGS,
    seed: int | None = options.SEED,
    output: Path = option(*options.OUTPUT),
    first: str | None = option(
        "--from STAGE",
        "First stage to run; products of earlier stages are used as they are.",
        shell_complete=completion.stages,
    ),
    last: str | None = option(
        "--to STAGE", "Last stage to run; later stages are left alone.", shell_complete=completion.stages
    ),
    force: bool = options.AGAIN,
    numbered: bool = option(
        "--numbered",
        "Keep every version: DIR/001, DIR/002, ...; DIR/latest links to the newest complete one.",
    ),
    dry_run: bool = options.DRY_RUN,
    jobs: int | None = options.THREADS,
    device: Device = option(*options.DEVICE, default="auto"),
    verbose: int = options.VERBOSE,
    quiet: bool = options.QUIET,
    as_json: bool = option("--json", "Print results.json (or the plan) instead of the table."),
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
    from irlos_pipe.pipeline import Selection, plan_run, run_recipe
    from irlos_pipe.pipeline.plan import Action
    from irlos_pipe.pipeline.run import run_numbered, version_for
    from irlos_pipe.pipeline.terminal import outcome_text, plan_text
    from irlos_pipe.recipe import load_recipe

    checked = load_recipe(recipe, settings, inputs_of(inputs, sof, recipe), seed, samples=samples)
    selection = Selection(first, last, force)
    if dry_run:
        folder = version_for(checked, output, selection) if numbered else output
        steps = plan_run(checked, folder, selection)[1]
        click.echo(plan_text(steps, as_json))
        _exit_if_any(_problems(checked, [step.name for step in steps if step.action is Action.RUN]))
        return
    with at_work(verbose, quiet):
        perform = run_numbered if numbered else run_recipe
        outcome = perform(checked, output, selection, resources_of(device, jobs, quiet))
    _finish(outcome, outcome_text(outcome, as_json) if as_json or not quiet else "")


@command(epilog=SEE_EXIT_CODES)
def reduce(
    files: tuple[Path, ...] = argument("FILE...", nargs=-1),
    recipe: str | None = option("--recipe NAME", "Recipe instead of the usual one for these files."),
    output: Path | None = option(
        "--output DIR", "Folder for the products (default: RECORDING-RECIPE in the current folder)."
    ),
    **given: Any,
) -> None:
    """Reduce the recordings in FILE, files or folders, with the recipe that their roles ask for.

    Roles, spectrum, diversity and instrument come from headers and side-cars (irlos sidecar FILE writes
    one). A calibration cube runs ncpa_calibration, a ramp with its calibration defocus_ramp, a series of
    angles derotator, four images of a 2x2 mode two_by_two; darks are used where they fit. The
    equivalent irlos run is printed first. What makes several reductions, or none, is refused.

    \b
    Examples:
      irlos reduce star.fits --dry-run
      irlos reduce ramp calibration.fits --output ramp-1
      irlos reduce star.fits --recipe diagnose
    """
    from irlos_pipe.night.files import job_text, reduction_of

    job = reduction_of(files, output, recipe)
    if not given["quiet"]:
        click.echo(job_text(job), err=not given["dry_run"] or given["as_json"])
    known = {"recipe": job.task.recipe, "inputs": job.task.inputs, "output": job.task.folder}
    click.get_current_context().invoke(run, **given, **known)


SHARED = ("settings", "force", "dry_run", "jobs", "device", "verbose", "quiet", "as_json")
reduce.params += [one for one in run.params if one.name in SHARED]


@command(epilog=SEE_EXIT_CODES)
def demo(
    output: Path = option(*options.OUTPUT, default=Path("demo")),
    settings: tuple[str, ...] = options.SETTINGS,
    seed: int | None = options.SEED,
    force: bool = options.AGAIN,
    jobs: int | None = options.THREADS,
    device: Device = option(*options.DEVICE, default="auto"),
    verbose: int = options.VERBOSE,
    quiet: bool = options.QUIET,
) -> None:
    """Reduce the sample recordings of the package and compare the result with the known truth.

    The recordings, a calibration cube and a focus ramp, are simulated. This is
    irlos run full_reduction --samples, followed by irlos score.

    \b
    Example:
      irlos demo --output demo
    """
    from irlos_pipe.files.shipped import SAMPLES, shipped_folder
    from irlos_pipe.pipeline import Selection, run_recipe
    from irlos_pipe.pipeline.terminal import outcome_text
    from irlos_pipe.recipe import load_recipe
    from irlos_pipe.report.score import score_run, score_text

    checked = load_recipe("full_reduction", settings, seed=seed, samples=True)
    with at_work(verbose, quiet):
        outcome = run_recipe(checked, output, Selection(force=force), resources_of(device, jobs, quiet))
    if quiet:
        _finish(outcome, "")
    click.echo(outcome_text(outcome, False))
    _finish(outcome, f"\n{score_text(score_run(output, shipped_folder(SAMPLES) / 'truth'))}")


@command(cls=options.OfRecipe, epilog=SEE_EXIT_CODES)
def validate(
    recipe: Path = options.RECIPE,
    inputs: tuple[str, ...] = options.INPUTS,
    sof: Path | None = options.SOF,
    samples: bool = options.SAMPLES,
    settings: tuple[str, ...] = options.SETTINGS,
    seed: int | None = options.SEED,
    as_json: bool = options.JSON,
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
        checked = load_recipe(recipe, settings, given, seed, samples=samples, needed="given")
        problems = _problems(checked)
    except IrlosError as error:
        if as_json:
            click.echo(Validation(recipe=str(recipe), problems=str(error).splitlines()).text())
        raise
    if as_json:
        inputs_given = {name: [str(path) for path in paths] for name, paths in checked.inputs.items()}
        told = {"recipe": str(recipe), "name": checked.name, "stages": list(checked.stages)}
        click.echo(Validation(**told, valid=not problems, inputs=inputs_given, problems=problems).text())
    _exit_if_any(problems)
    if not as_json:
        open_inputs = [name for name, paths in checked.inputs.items() if not paths]
        rest = f"; to be given: {', '.join(open_inputs)}" if open_inputs else ""
        click.echo(f"{recipe}: recipe '{checked.name}' is valid: {', '.join(checked.stages)}{rest}")


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


def _finish(outcome: Outcome, text: str) -> NoReturn:
    """Print a text, if there is one, and exit with the code of the outcome."""
    if text:
        click.echo(text)
    if outcome.report_error:
        report_error(outcome.report_error)
    sys.exit(outcome.exit_code)
