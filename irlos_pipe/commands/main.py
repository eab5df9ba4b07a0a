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


@cli.command()
@click.argument("folder", metavar="DIR", type=FOLDER)
def status(folder: Path) -> None:
    """Show for each product of the run in DIR whether it is up to date, and if not, why.

    \b
    Example:
      irlos status demo
    """
    from irlos_pipe.commands.show import status_text

    click.echo(status_text(folder))


@cli.command()
@click.argument("product", metavar="PRODUCT.h5", type=FOLDER)
def show(product: Path) -> None:
    """Show what PRODUCT.h5 contains: arrays with units, results, configuration, QC, provenance, log.

    \b
    Example:
      irlos show demo/03_calibrate.h5
    """
    from irlos_pipe.commands.show import product_text

    click.echo(product_text(product))


@cli.command()
@click.argument("folder", metavar="DIR", type=FOLDER)
def report(folder: Path) -> None:
    """Write DIR/report.html again from the products of a run.

    \b
    Example:
      irlos report demo
    """
    from irlos_pipe.product.runfolder import existing_run, owned_folder

    with owned_folder(existing_run(folder).path) as run_folder:
        from irlos_pipe.report.build import write_report

        click.echo(write_report(run_folder.path))


@cli.command()
@click.argument("product", metavar="PRODUCT.h5", type=FOLDER)
@click.option(
    "--array",
    "arrays",
    metavar="NAME",
    multiple=True,
    required=True,
    help="Array to copy; irlos show PRODUCT.h5 lists the names. May be repeated.",
)
@click.option("--output", type=FOLDER, required=True, metavar="FILE", help="File to write, .fits or .csv.")
@click.option("--force", is_flag=True, help="Replace FILE if it exists.")
def export(product: Path, arrays: tuple[str, ...], output: Path, force: bool) -> None:
    """Copy arrays out of PRODUCT.h5 into a FITS or CSV file.

    A FITS file holds arrays of any shape, one extension each, with the unit in BUNIT and errors in
    extensions of their own. A CSV file holds columns of equal length, or one matrix.

    \b
    Examples:
      irlos export demo/03_calibrate.h5 --array zernike_nm --output ncpa.csv
      irlos export demo/01_ingest.h5 --array recordings/calibration/sky/images_e --output frames.fits
    """
    from irlos_pipe.product.export import export_arrays
    from irlos_pipe.product.storage import read_product

    export_arrays(read_product(product), arrays, output, replace=force)
    click.echo(output)


@cli.command(epilog=EXIT_CODES)
@click.argument("spec", metavar="SPEC.yaml", type=FOLDER)
@click.option(
    "--output", type=FOLDER, required=True, metavar="DIR", help="Folder for the recordings and their truth."
)
@click.option(
    "--set",
    "settings",
    metavar="KEY=VALUE",
    multiple=True,
    help="Change a value of the specification; VALUE is YAML. May be repeated.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    metavar="N",
    help="Seed of the random numbers (default: that of the specification).",
)
@click.option("--force", is_flag=True, help="Make recordings again even if they are up to date.")
@click.option("--dry-run", is_flag=True, help="Print what would be made and why; change nothing.")
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N", help="Number of processes (default: all processors)."
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def simulate(
    spec: Path,
    output: Path,
    settings: tuple[str, ...],
    seed: int | None,
    force: bool,
    dry_run: bool,
    jobs: int | None,
    quiet: bool,
) -> None:
    """Simulate the recordings that SPEC.yaml specifies and write them to the folder DIR.

    The specification states star, aberrations, sky, image motion, detector and other disturbances;
    those in recipes/simulations have comments and are meant to be copied. The same specification
    and seed give the same data for any --jobs. A recording that exists already is not made again;
    a recording appears only when it is complete.

    \b
    Examples:
      irlos simulate recipes/simulations/on_sky.yaml --output sim --dry-run
      irlos simulate recipes/simulations/on_sky.yaml --output sim
      irlos run recipes/full_reduction.yaml --output sim/run \\
            --input calibration=sim/data/calibration --input ramp=sim/data/ramp
      irlos score sim/run --truth sim/truth
      irlos simulate recipes/simulations/on_sky.yaml --output sim-1 --seed 1
      irlos simulate recipes/simulations/on_sky.yaml --output faint \\
            --set recordings.ramp.mag_j=16 --set sky.seeing_arcsec=1.0
      irlos simulate recipes/simulations/bench.yaml --output mine \\
            --set 'effects={companion: {flux_ratio: 0.05, sep_mas: 150, pa_deg: 30}}'

    \b
    DIR will hold:
      data/<recording>/         what an observer gets: frames, darks, side-car
      truth/<recording>.json    the truth: wavefront, hidden effects, all parameters
      truth/*_wavefront.fits    mean wavefront, pupil, Zernikes per frame
      simulation.resolved.yaml  the specification with every default; can be simulated again
    """
    from irlos_pipe.conventions.text import aligned
    from irlos_pipe.pipeline.terminal import messages
    from irlos_pipe.simulate.recordings.run import plan_simulation
    from irlos_pipe.simulate.recordings.run import simulate as simulate_recordings
    from irlos_pipe.simulate.recordings.spec import load_spec
    from irlos_pipe.simulate.recordings.summary import plan_rows, where_text

    checked = load_spec(spec, settings, seed)
    if dry_run:
        click.echo(aligned(plan_rows(plan_simulation(checked, output, force))))
        return
    resources = resources_of("cpu", jobs, quiet)
    with terminated_like_interrupted(), messages(-1 if quiet else 0):
        simulate_recordings(checked, output, force, resources.jobs, resources.progress)
    if not quiet:
        click.echo(where_text(checked, output))


@cli.command()
@click.argument("folder", metavar="DIR", type=FOLDER)
@click.option(
    "--truth",
    type=FOLDER,
    required=True,
    metavar="PATH",
    help="Truth of the recordings: a JSON file, or a folder of them.",
)
def score(folder: Path, truth: Path) -> None:
    """Compare the results of the run in DIR with the truth of simulated data.

    The table lists the errors of every calibration method and of the ramp.

    \b
    Example:
      irlos score demo --truth data_samples/truth
    """
    from irlos_pipe.report.score import score_run

    click.echo(score_run(folder, truth))


@cli.command(epilog=EXIT_CODES)
@click.option(
    "--output", type=FOLDER, required=True, metavar="DIR", help="Folder for the runs of all experiments."
)
@click.option(
    "--quick",
    is_flag=True,
    help="Use small samples (recipes/paper/quick.yaml), which takes minutes instead of hours.",
)
@click.option("--only", metavar="NAME", multiple=True, help="Run only this experiment. May be repeated.")
@click.option(
    "--recipes",
    type=FOLDER,
    default=Path("recipes/paper"),
    show_default=True,
    metavar="DIR",
    help="Folder with the recipes of the experiments.",
)
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N", help="Number of processes (default: all processors)."
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    metavar="N",
    help="Seed of the random numbers (default: those of the recipes).",
)
@click.option(
    "-v", "--verbose", count=True, help="Print more messages; -vv prints debugging messages as well."
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
def paper(
    output: Path,
    quick: bool,
    only: tuple[str, ...],
    recipes: Path,
    jobs: int | None,
    seed: int | None,
    verbose: int,
    quiet: bool,
) -> None:
    """Run every experiment of the paper on simulated data and summarise all of them in DIR.

    Experiments that are up to date are skipped, and an interrupted run continues where it stopped,
    even in the middle of an experiment. An experiment that fails does not stop the others (exit
    code 5). Results do not depend on --jobs.

    \b
    Examples:
      irlos paper --output runs/paper-quick --quick
      irlos paper --output runs/paper
      irlos paper --output runs/paper --only methods --only slow_loop -v

    \b
    DIR will hold:
      report.html         every figure and table, in the order of the paper
      paper_results.json  all numbers with seeds and sizes, for scripts
      <experiment>/       the run of each: report.html, results.json, products (irlos show)
    """
    from irlos_pipe.paper.run.recipes import find_experiments
    from irlos_pipe.paper.run.run import run_paper, summary_text
    from irlos_pipe.pipeline.terminal import messages

    if verbose and quiet:
        raise click.UsageError("-v and -q exclude each other")
    experiments = find_experiments(recipes, quick=quick, only=only, seed=seed)
    with terminated_like_interrupted(), messages(-1 if quiet else verbose):
        ran = run_paper(experiments, output, quick, resources_of("cpu", jobs, quiet))
    if not quiet:
        click.echo(summary_text(ran))
    for name, problem in ran.problems.items():
        report_error(f"{name}: {problem}")
    sys.exit(ran.exit_code)


def _finish(outcome: Outcome, as_json: bool, quiet: bool) -> NoReturn:
    """Print the result and exit with its code."""
    from irlos_pipe.pipeline.terminal import outcome_text

    if as_json or not quiet:
        click.echo(outcome_text(outcome, as_json))
    if outcome.report_error:
        report_error(outcome.report_error)
    sys.exit(outcome.exit_code)


for command in (night, trend):
    cli.add_command(command)
