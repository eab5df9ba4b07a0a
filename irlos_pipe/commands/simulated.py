"""Commands that make their own data: simulate, paper."""

import sys
from pathlib import Path

import click

from irlos_pipe.commands import completion, options
from irlos_pipe.commands.exits import SEE_EXIT_CODES, report_error
from irlos_pipe.commands.options import FROM_0, argument, at_work, command, option, resources_of

SPECIFICATIONS = completion.or_files(completion.specifications)


@command(epilog=SEE_EXIT_CODES)
def simulate(
    spec: Path = argument("SPEC", shell_complete=SPECIFICATIONS),
    output: Path = option("--output DIR", "Folder for the recordings and their truth."),
    settings: tuple[str, ...] = option(
        "--set KEY=VALUE", "Change a value of the specification; VALUE is YAML. May be repeated."
    ),
    seed: int | None = option(
        "--seed N", "Seed of the random numbers (default: that of the specification).", type=FROM_0
    ),
    force: bool = option("--force", "Make recordings again even if they are up to date."),
    dry_run: bool = option("--dry-run", "Print what would be made and why; change nothing."),
    jobs: int | None = options.PROCESSES,
    quiet: bool = options.QUIET,
) -> None:
    """Simulate the recordings that SPEC specifies and write them to the folder DIR.

    SPEC is the path of a specification, or the name of one that comes with the package (irlos
    recipes). It states star, aberrations, sky, image motion, detector and other disturbances; those
    of the package have comments and are meant to be copied (irlos recipes NAME). The same specification
    and seed give the same data for any --jobs. A recording that exists already is not made again;
    a recording appears only when it is complete.

    \b
    Examples:
      irlos simulate on_sky --output sim --dry-run
      irlos simulate on_sky --output sim
      irlos run full_reduction --output sim/run \\
            --input calibration=sim/data/calibration --input ramp=sim/data/ramp
      irlos score sim/run --truth sim/truth
      irlos simulate on_sky --output sim-1 --seed 1
      irlos simulate on_sky --output faint \\
            --set recordings.ramp.mag_j=16 --set sky.seeing_arcsec=1.0
      irlos simulate bench --output mine \\
            --set 'effects={companion: {flux_ratio: 0.05, sep_mas: 150, pa_deg: 30}}'

    \b
    DIR will hold:
      data/<recording>/         what an observer gets: frames, darks, side-car
      truth/<recording>.json    the truth: wavefront, hidden effects, all parameters
      truth/*_wavefront.fits    mean wavefront, pupil, Zernikes per frame
      simulation.resolved.yaml  the specification with every default; can be simulated again
    """
    from irlos_pipe.conventions.text import aligned
    from irlos_pipe.simulate.recordings.run import plan_rows, plan_simulation
    from irlos_pipe.simulate.recordings.run import simulate as simulate_recordings
    from irlos_pipe.simulate.recordings.spec import load_spec

    checked = load_spec(spec, settings, seed)
    if dry_run:
        click.echo(aligned(plan_rows(plan_simulation(checked, output, force))))
        return
    resources = resources_of("cpu", jobs, quiet)
    with at_work(0, quiet):
        simulate_recordings(checked, output, force, resources.jobs, resources.progress)
    if not quiet:
        width = max(len("truth"), *map(len, checked.recordings))
        places = {name: output / "data" / name for name in checked.recordings} | {"truth": output / "truth"}
        click.echo("\n".join(f"{name:<{width}}  {path}" for name, path in places.items()))


@command(epilog=SEE_EXIT_CODES)
def paper(
    output: Path = option("--output DIR", "Folder for the runs of all experiments."),
    quick: bool = option(
        "--quick",
        "Use small samples (quick.yaml beside the recipes), which takes minutes instead of hours.",
    ),
    only: tuple[str, ...] = option("--only NAME", "Run only this experiment. May be repeated."),
    recipes: Path | None = option(
        "--recipes DIR", "Folder with the recipes of the experiments (default: those of the package)."
    ),
    jobs: int | None = options.PROCESSES,
    seed: int | None = option(
        "--seed N", "Seed of the random numbers (default: those of the recipes).", type=FROM_0
    ),
    verbose: int = options.VERBOSE,
    quiet: bool = options.QUIET,
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
      report.html      every figure and table, in the order of the paper
      tables/          all numbers for scripts: <experiment>.csv; checks.csv; runs.csv (seeds, sizes)
      <experiment>/    the run of each: report.html, results.json, products (irlos show)
    """
    from irlos_pipe.files.shipped import PAPER, shipped_folder
    from irlos_pipe.paper.run.run import find_experiments, run_paper

    with at_work(verbose, quiet):
        experiments = find_experiments(recipes or shipped_folder(PAPER), quick=quick, only=only, seed=seed)
        ran = run_paper(experiments, output, quick, resources_of("cpu", jobs, quiet))
    if not quiet:
        click.echo(ran.summary())
    for name, problem in ran.problems.items():
        report_error(f"{name}: {problem}")
    sys.exit(ran.exit_code)
