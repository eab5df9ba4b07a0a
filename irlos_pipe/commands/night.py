"""The commands for nights: each parses its options, calls the work and ends with its exit code."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from irlos_pipe.commands.exits import EXIT_CODES, report_error, terminated_like_interrupted
from irlos_pipe.commands.options import FOLDER, resources_of
from irlos_pipe.conventions.errors import ExitCode, NothingToDo

if TYPE_CHECKING:
    from irlos_pipe.night.reduce import Runner

DATE = click.DateTime(["%Y-%m-%d"])
CONFIG = click.option(
    "--config",
    type=FOLDER,
    metavar="FILE",
    help="YAML file with recipes, settings and bands (docs/night.md).",
)


@click.command(epilog=EXIT_CODES)
@click.argument("folders", metavar="NIGHT_DIR...", type=FOLDER, nargs=-1, required=True)
@click.option(
    "--output", type=FOLDER, required=True, metavar="TREE", help="Folder for the products of all nights."
)
@CONFIG
@click.option(
    "--recipe",
    "recipes",
    metavar="KIND=RECIPE",
    multiple=True,
    help="Recipe for groups of KIND calibration, ramp, derotator or psf, by path or name. "
    "A KIND given again makes a list.",
)
@click.option("--since", type=DATE, metavar="DATE", help="First night to be looked at, YYYY-MM-DD.")
@click.option("--dry-run", is_flag=True, help="Print what would be done and why; change nothing.")
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N", help="Number of processes (default: all processors)."
)
@click.option(
    "--device",
    type=click.Choice(["cpu", "cuda", "auto"]),
    default="cpu",
    show_default=True,
    help="Processor or graphics card; auto takes the graphics card if there is one.",
)
@click.option(
    "--engine",
    type=click.Choice(["local", "dask"]),
    default="local",
    show_default=True,
    help="Work in processes of this machine, or on a Dask cluster (docs/scale_out.md).",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Address of the scheduler of the cluster, for example tls://10.0.0.1:8786.",
)
@click.option(
    "--acknowledge",
    is_flag=True,
    help="What is wrong now is known: show it on the pages, but do not report it again.",
)
@click.option(
    "--limit",
    "limit_min",
    type=click.FloatRange(min=0, min_open=True),
    metavar="MIN",
    help="Longest time for one reduction [min]; it is stopped then, the others go on (default: 60).",
)
@click.option("-v", "--verbose", count=True, help="Print what is done; -vv prints all messages.")
@click.option("--json", "as_json", is_flag=True, help="Print what was done (or the plan) as JSON.")
def night(
    folders: tuple[Path, ...],
    output: Path,
    config: Path | None,
    recipes: tuple[str, ...],
    since: object,
    dry_run: bool,
    jobs: int | None,
    device: str,
    engine: str,
    scheduler: str | None,
    acknowledge: bool,
    limit_min: float | None,
    verbose: int,
    as_json: bool,
) -> None:
    """Reduce every recording under NIGHT_DIR that is new, or whose products are out of date.

    NIGHT_DIR is a night, or an archive of many. Recordings are grouped by role, time and
    configuration: a calibration cube by itself, a ramp with the calibration that serves it, a
    series of derotator angles. A recording that cannot be reduced is named and does not stop the
    others. Products that are up to date are left alone; after a change of model, recipe or settings
    exactly what depends on it is made again, and the old products stay until all new ones are there.

    Nothing is printed when all is well, and one line when somebody should have a look.

    \b
    Examples:
      irlos night /data/irlos/2024-02-10 --output /data/reduced
      irlos night /data/irlos --output /data/reduced --since 2024-01-01 --dry-run
      irlos night 2024-02-10 --output reduced --recipe ramp=full_reduction -v
      irlos night /data/irlos --output /data/reduced --engine dask --scheduler tls://10.0.0.1:8786
      irlos night /data/irlos --output /data/reduced --acknowledge

    \b
    TREE will hold:
      night_<date>.html          what came in, what became of it, the trends
      <date>/<group>/<recipe>/   the run of each: report.html, results.json, products (irlos show)
      trend.sqlite               the numbers of all nights (irlos trend TREE)
      night.log                  messages of all runs into this folder
      acknowledged.txt           problems that are known (--acknowledge)
    """
    from irlos_pipe.night.run import Request, plan_night, run_night
    from irlos_pipe.night.settings import load_settings
    from irlos_pipe.night.terminal import attention_line, night_json, night_text, plan_text
    from irlos_pipe.pipeline.terminal import messages

    resources = resources_of(device, jobs, quiet=True)
    runner = _runner(engine, scheduler, resources.jobs)
    settings = load_settings(config, recipes)
    if limit_min is not None:
        settings = settings.model_copy(update={"limit_min": limit_min})
    request = Request(folders, output, settings, _date(since), resources.device, acknowledge)
    if dry_run:
        with _nothing_to_do_is_silent(verbose, as_json):
            click.echo(plan_text(*plan_night(request), as_json))
        return
    with _nothing_to_do_is_silent(verbose, as_json), terminated_like_interrupted(), messages(verbose - 1):
        state = run_night(request, runner)
    if as_json or verbose:
        click.echo(night_json(state, output) if as_json else night_text(state, output))
    if line := attention_line(state, output):
        report_error(line)
    sys.exit(state.exit_code)


@click.command(epilog=EXIT_CODES)
@click.argument("tree", metavar="TREE", type=FOLDER)
@click.option(
    "--of",
    "names",
    metavar="NAME",
    multiple=True,
    help="Number to show, for example noll_4_nm. May be repeated (default: all, in a plot the first 16).",
)
@CONFIG
@click.option("--until", type=DATE, metavar="DATE", help="Last night to be looked at, YYYY-MM-DD.")
@click.option("--all", "everything", is_flag=True, help="Print every mode and verdict, too.")
@click.option("--json", "as_json", is_flag=True, help="Print all points, bands and alarms as JSON.")
@click.option("--csv", "as_csv", is_flag=True, help="Print all points with their bands as CSV.")
@click.option(
    "--dashboard",
    type=FOLDER,
    metavar="FILE",
    help="Write a dashboard for Grafana that reads TREE/trend.sqlite to FILE, a .json.",
)
@click.option("--plot", type=FOLDER, metavar="FILE", help="Draw a plot to FILE, a .svg, .png or .pdf.")
def trend(
    tree: Path,
    names: tuple[str, ...],
    config: Path | None,
    until: object,
    everything: bool,
    as_json: bool,
    as_csv: bool,
    dashboard: Path | None,
    plot: Path | None,
) -> None:
    """Show how NCPAs, defocus bias, seeing and the verdicts of diagnose changed from night to night.

    Every number is compared with the band of the nights before it and with the limits of the
    configuration, and all modes together with the wavefront of these nights; what is not as
    expected in the last night is reported and makes the exit code 4. The stability of the NCPAs is
    shown by their structure function: the RMS change of the wavefront against the time between two
    calibrations, and how long a calibration is valid.

    \b
    Examples:
      irlos trend /data/irlos/reduced
      irlos trend /data/irlos/reduced --of noll_4_nm --of noll_6_nm --plot focus.png
      irlos trend /data/irlos/reduced --json > trend.json
      irlos trend /data/irlos/reduced --csv > trend.csv
      irlos trend /data/irlos/reduced --dashboard irlos.json
    """
    from irlos_pipe.night.database import write_dashboard
    from irlos_pipe.night.settings import load_settings
    from irlos_pipe.night.terminal import alarms_line, trend_csv, trend_json, trend_text
    from irlos_pipe.night.trend import read_trend

    if as_json and as_csv:
        raise click.UsageError("--json and --csv exclude each other")

    found = read_trend(tree, load_settings(config).band, names, _date(until))
    if plot is not None:
        from irlos_pipe.night.trend_plots import save_plot

        save_plot(found, plot)
    if dashboard is not None:
        write_dashboard(tree, dashboard)
    if as_csv:
        click.echo(trend_csv(found), nl=False)
    else:
        click.echo(trend_json(found) if as_json else trend_text(found, everything or bool(names)))
    if alarms_line(found):
        report_error(alarms_line(found))
        sys.exit(ExitCode.QUALITY)


def _runner(engine: str, scheduler: str | None, jobs: int) -> Runner:
    """Return what works on the tasks."""
    if engine == "dask" and scheduler:
        from irlos_pipe.night.engines import dask_runner

        return dask_runner(scheduler)
    if engine == "dask" or scheduler:
        raise click.UsageError("--engine dask and --scheduler ADDRESS need each other")
    from irlos_pipe.night.engines import local_runner

    return local_runner(jobs)


@contextmanager
def _nothing_to_do_is_silent(verbose: int, as_json: bool) -> Iterator[None]:
    """End quietly without recordings, so that cron sends no mail; the page and the exit code state it."""
    try:
        yield
    except NothingToDo as nothing:
        if as_json:
            from irlos_pipe.night.terminal import nothing_json

            click.echo(nothing_json(str(nothing)))
        if verbose or sys.stderr.isatty():
            raise
        sys.exit(nothing.exit_code)


def _date(moment: object) -> str:
    return "" if moment is None else f"{moment:%Y-%m-%d}"
