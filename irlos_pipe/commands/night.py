"""The commands for nights: each parses its options, calls the work and ends with its exit code."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from irlos_pipe.commands import options
from irlos_pipe.commands.exits import SEE_EXIT_CODES, report_error
from irlos_pipe.commands.options import Device, argument, command, option, resources_of
from irlos_pipe.conventions.errors import ExitCode, NothingToDo

if TYPE_CHECKING:
    from irlos_pipe.night.reduce import Runner

DATE = click.DateTime(["%Y-%m-%d"])
CONFIG = option("--config FILE", "YAML file with recipes, settings and bands (docs/night.md).")


@command(epilog=SEE_EXIT_CODES)
def night(
    folders: tuple[Path, ...] = argument("NIGHT_DIR...", nargs=-1),
    output: Path = option("--output TREE", "Folder for the products of all nights."),
    config: Path | None = CONFIG,
    recipes: tuple[str, ...] = option(
        "--recipe KIND=RECIPE",
        "Recipe for groups of KIND calibration, ramp, derotator or psf, by path or name. "
        "A KIND given again makes a list.",
    ),
    since: object | None = option("--since DATE", "First night to be looked at, YYYY-MM-DD.", type=DATE),
    dry_run: bool = options.DRY_RUN,
    jobs: int | None = options.PROCESSES,
    device: Device = option(*options.DEVICE, default="cpu"),
    engine: Literal["local", "dask"] = option(
        "--engine",
        "Work in processes of this machine, or on a Dask cluster (docs/scale_out.md).",
        default="local",
    ),
    scheduler: str | None = option(
        "--scheduler ADDRESS", "Address of the scheduler of the cluster, for example tls://10.0.0.1:8786."
    ),
    acknowledge: bool = option(
        "--acknowledge", "What is wrong now is known: show it on the pages, but do not report it again."
    ),
    limit_min: float | None = option(
        "--limit MIN",
        "Longest time for one reduction [min]; it is stopped then, the others go on (default: 60).",
        type=click.FloatRange(min=0, min_open=True),
    ),
    verbose: int = option("-v, --verbose", "Print what is done; -vv prints all messages.", count=True),
    as_json: bool = option("--json", "Print what was done (or the plan) as JSON."),
) -> None:
    """Reduce every recording under NIGHT_DIR that is new, or whose products are out of date.

    NIGHT_DIR is a night, or an archive of many. Recordings are grouped by role, time and
    configuration: a calibration cube by itself, a ramp with the calibration that serves it, a
    series of derotator angles. A recording that cannot be reduced is named and does not stop the
    others. Products that are up to date are left alone; after a change of model, recipe or settings
    exactly what depends on it is made again, and the old products stay until all new ones are there.

    A terminal shows how far the work is. Elsewhere, as in cron, nothing is printed when all is well, and
    one line when somebody should have a look.

    \b
    Examples:
      irlos night /data/irlos/2024-02-10 --output /data/reduced
      irlos night /data/irlos --output /data/reduced --since 2024-01-01 --dry-run
      irlos night 2024-02-10 --output reduced --recipe ramp=full_reduction -v
      irlos night /data/irlos --output /data/reduced --engine dask --scheduler tls://10.0.0.1:8786
      irlos night /data/irlos --output /data/reduced --acknowledge

    \b
    TREE will hold:
      index.html                 all nights, with the result of every reduction
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
    shown = verbose - 1 if verbose or not sys.stderr.isatty() else 0  # somebody is looking
    with _nothing_to_do_is_silent(verbose, as_json), messages(shown):
        state = run_night(request, runner)
    if as_json or verbose:
        click.echo(night_json(state, output) if as_json else night_text(state, output))
    if line := attention_line(state, output):
        report_error(line)
    sys.exit(state.exit_code)


@command(epilog=SEE_EXIT_CODES)
def trend(
    tree: Path = argument("TREE"),
    names: tuple[str, ...] = option(
        "--of NAME",
        "Number to show, for example noll_4_nm. May be repeated (default: all, in a plot the first 16).",
    ),
    config: Path | None = CONFIG,
    until: object | None = option("--until DATE", "Last night to be looked at, YYYY-MM-DD.", type=DATE),
    everything: bool = option("--all", "Print every mode and verdict, too."),
    as_json: bool = option("--json", "Print all points, bands and alarms as JSON."),
    as_csv: bool = option("--csv", "Print all points with their bands as CSV."),
    dashboard: Path | None = option(
        "--dashboard FILE", "Write a dashboard for Grafana that reads TREE/trend.sqlite to FILE, a .json."
    ),
    plot: Path | None = option("--plot FILE", "Draw a plot to FILE, a .svg, .png or .pdf."),
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
