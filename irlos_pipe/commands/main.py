"""The commands: parse, call, exit code. Nothing else."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

import irlos_pipe
from irlos_pipe.commands.exits import EXIT_CODES, IrlosGroup, tell, terminated_like_interrupted
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

    Each command explains itself: irlos COMMAND --help
    """


@cli.command(epilog=EXIT_CODES)
@recipe_options
@click.option("--output", type=FOLDER, required=True, metavar="DIR", help="Folder of the run.")
@click.option("--from", "first", metavar="STAGE", help="First stage to run; earlier products are used as is.")
@click.option("--to", "last", metavar="STAGE", help="Last stage to run.")
@click.option("--force", is_flag=True, help="Run stages that are up to date as well.")
@click.option("--dry-run", is_flag=True, help="Say what would be done and why; touch nothing.")
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Threads (default: all processors).")
@click.option("--device", type=click.Choice(["cpu", "cuda", "auto"]), default="auto", show_default=True)
@click.option("-v", "--verbose", count=True, help="Tell more; -vv for debugging.")
@click.option("-q", "--quiet", is_flag=True, help="Tell errors only.")
@click.option("--json", "as_json", is_flag=True, help="Print results.json (or the plan), no table.")
def run(
    recipe: Path,
    output: Path,
    first: str,
    last: str,
    force: bool,
    dry_run: bool,
    jobs: int,
    device: str,
    verbose: int,
    quiet: bool,
    as_json: bool,
    **changes: object,
) -> None:
    """Run RECIPE into the folder DIR.

    Running again into the same folder skips what is up to date, and says why anything is redone:
    a changed setting, input file, instrument profile or software.

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
      run.log               what happened
      recipe.resolved.yaml  the recipe with every default; can be run again
    """
    from irlos_pipe.pipeline import Selection, plan_run, run_recipe
    from irlos_pipe.pipeline.terminal import messages, plan_text
    from irlos_pipe.recipe import load_recipe

    if verbose and quiet:
        raise click.UsageError("-v and -q exclude each other")
    checked, selection = load_recipe(recipe, **changes), Selection(first, last, force)
    if dry_run:
        click.echo(plan_text(plan_run(checked, output, selection)[1], as_json))
        return
    with terminated_like_interrupted(), messages(-1 if quiet else verbose):
        outcome = run_recipe(checked, output, selection, resources_of(device, jobs, quiet))
    _finish(outcome, as_json, quiet)


@cli.command()
@recipe_options
def validate(recipe: Path, **changes: object) -> None:
    """Check RECIPE, its options and its inputs without running anything.

    All errors are told at once, each as file:line: message (or --set KEY: message).

    \b
    Examples:
      irlos validate recipes/full_reduction.yaml
      irlos validate recipes/ncpa_calibration.yaml --input calibration=2023-07-14
    """
    from irlos_pipe.recipe import load_recipe

    checked = load_recipe(recipe, **changes)
    click.echo(f"{recipe}: recipe '{checked.name}' is valid: {', '.join(checked.stages)}")


@cli.command()
@click.argument("folder", metavar="DIR", type=FOLDER)
def status(folder: Path) -> None:
    """Say for each product of the run in DIR whether it is up to date, and why not.

    \b
    Example:
      irlos status demo
    """
    from irlos_pipe.commands.show import status_text

    click.echo(status_text(folder))


@cli.command()
@click.argument("product", metavar="PRODUCT.h5", type=FOLDER)
def show(product: Path) -> None:
    """Show what PRODUCT.h5 holds: arrays with units, results, configuration, QC, provenance, log.

    \b
    Example:
      irlos show demo/03_calibrate.h5
    """
    from irlos_pipe.commands.show import product_text

    click.echo(product_text(product))


@cli.command()
@click.argument("folder", metavar="DIR", type=FOLDER)
def report(folder: Path) -> None:
    """Build DIR/report.html again from the products of a run.

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
    help="Array to copy (names: irlos show PRODUCT.h5). May be repeated.",
)
@click.option("--output", type=FOLDER, required=True, metavar="FILE", help="A .fits or .csv file.")
@click.option("--force", is_flag=True, help="Replace FILE if it exists.")
def export(product: Path, arrays: tuple[str, ...], output: Path, force: bool) -> None:
    """Copy arrays out of PRODUCT.h5 into a FITS or CSV file.

    FITS holds arrays of any shape, one extension each, with the unit in BUNIT and errors in
    extensions of their own. CSV holds columns of equal length, or one matrix.

    \b
    Examples:
      irlos export demo/03_calibrate.h5 --array zernike_nm --output ncpa.csv
      irlos export demo/01_ingest.h5 --array recordings/calibration/sky/images_e --output frames.fits
    """
    from irlos_pipe.product.export import export_arrays
    from irlos_pipe.product.product import read_product

    export_arrays(read_product(product), arrays, output, replace=force)
    click.echo(output)


@cli.command(epilog=EXIT_CODES)
@click.argument("spec", metavar="SPEC.yaml", type=FOLDER)
@click.option("--output", type=FOLDER, required=True, metavar="DIR", help="Folder of the simulation.")
@click.option(
    "--set",
    "settings",
    metavar="KEY=VALUE",
    multiple=True,
    help="Change a value of the spec; VALUE is YAML. May be repeated.",
)
@click.option("--seed", type=click.IntRange(min=0), metavar="N", help="Seed in place of the spec's.")
@click.option("--force", is_flag=True, help="Make recordings again that are up to date.")
@click.option("--dry-run", is_flag=True, help="Say what would be made and why; touch nothing.")
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Processes (default: all processors).")
@click.option("-q", "--quiet", is_flag=True, help="Tell errors only.")
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
    """Simulate the recordings of SPEC.yaml into the folder DIR.

    The spec says star, aberrations, sky, image motion, detector and what else disturbs the
    recordings; those in recipes/simulations are commented and meant to be copied. The same spec
    and seed give the same data, whatever --jobs; a recording that is there already is not made
    again. A recording appears when it is complete.

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
      truth/<recording>.json    what there really was: wavefront, hidden effects, all parameters
      truth/*_wavefront.fits    mean wavefront, pupil, Zernikes per frame
      simulation.resolved.yaml  the spec with every default; can be simulated again
    """
    from irlos_pipe.conventions.text import aligned
    from irlos_pipe.pipeline.terminal import messages
    from irlos_pipe.simulate.recordings import load_spec, plan_rows, plan_simulation, where_text
    from irlos_pipe.simulate.recordings import simulate as simulate_recordings

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
@click.option("--truth", type=FOLDER, required=True, metavar="PATH", help="Folder or file with the truth.")
def score(folder: Path, truth: Path) -> None:
    """Compare the run in DIR with the truth of simulated data.

    \b
    Example:
      irlos score demo --truth data_samples/truth
    """
    from irlos_pipe.report.score import score_run

    click.echo(score_run(folder, truth))


@cli.command(epilog=EXIT_CODES)
@click.option("--output", type=FOLDER, required=True, metavar="DIR", help="Folder of all experiments.")
@click.option("--quick", is_flag=True, help="Small samples (recipes/paper/quick.yaml): minutes, not hours.")
@click.option("--only", metavar="NAME", multiple=True, help="Run only this experiment. May be repeated.")
@click.option(
    "--recipes",
    type=FOLDER,
    default=Path("recipes/paper"),
    show_default=True,
    metavar="DIR",
    help="Folder of the experiments' recipes.",
)
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Processes (default: all processors).")
@click.option("--seed", type=click.IntRange(min=0), metavar="N", help="Seed in place of the recipes'.")
@click.option("-v", "--verbose", count=True, help="Tell more; -vv for debugging.")
@click.option("-q", "--quiet", is_flag=True, help="Tell errors only.")
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
    """Run every experiment of the paper on simulated data, and sum up all of them in DIR.

    What is up to date is skipped, and an interrupted run goes on where it stopped, in the middle of
    an experiment too. An experiment that fails does not stop the others (exit code 5). Results do
    not depend on --jobs. Run it in the source tree, where recipes/paper is.

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
    from irlos_pipe.paper.run.experiments import find_experiments
    from irlos_pipe.paper.run.run import run_paper
    from irlos_pipe.paper.run.text import ran_text
    from irlos_pipe.pipeline.terminal import messages

    if verbose and quiet:
        raise click.UsageError("-v and -q exclude each other")
    experiments = find_experiments(recipes, quick=quick, only=only, seed=seed)
    with terminated_like_interrupted(), messages(-1 if quiet else verbose):
        ran = run_paper(experiments, output, quick, resources_of("cpu", jobs, quiet))
    if not quiet:
        click.echo(ran_text(ran))
    for name, problem in ran.problems.items():
        tell(f"{name}: {problem}")
    sys.exit(ran.exit_code)


def _finish(outcome: Outcome, as_json: bool, quiet: bool) -> NoReturn:
    """Print the result and exit with its code."""
    from irlos_pipe.pipeline.terminal import outcome_text

    if as_json or not quiet:
        click.echo(outcome_text(outcome, as_json))
    if outcome.report_error:
        tell(outcome.report_error)
    sys.exit(outcome.exit_code)


for command in (night, trend):
    cli.add_command(command)
