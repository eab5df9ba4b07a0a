"""Commands on finished runs: status, show, compare, report, export, score."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import click

from irlos_pipe.commands import completion, options
from irlos_pipe.commands.options import argument, command, option
from irlos_pipe.conventions.errors import InputDataError


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Name the product or folder `path` whose content is whole and makes no sense: others wrote it."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        problem = next(iter(str(error).splitlines()), "")
        raise InputDataError(
            f"{path}: its content makes no sense ({type(error).__name__}: {problem}); run the recipe again"
        ) from error


@command()
def status(folder: Path = argument("DIR"), as_json: bool = options.JSON) -> None:
    """Show for each product of the run in DIR whether it is up to date, and if not, why.

    Of a folder with numbered versions (irlos run --numbered) it lists the versions.

    \b
    Examples:
      irlos status demo
      irlos status demo --json
    """
    from irlos_pipe.commands.text import run_status, status_text, versions_text
    from irlos_pipe.product.run_table import version_folders, versions_in

    with readable(folder):
        if version_folders(folder):
            versions = versions_in(folder)
            click.echo(versions.text() if as_json else versions_text(versions))
        else:
            found = run_status(folder)
            click.echo(found.text() if as_json else status_text(found))


@command()
def show(product: Path = argument("PRODUCT.h5|DIR|FITS"), as_json: bool = options.JSON) -> None:
    """Show what a product, the folder of a run or a recording holds, and what can be done with it.

    Of PRODUCT.h5: arrays with units, results, configuration, QC, provenance, log. The values of arrays
    are not shown: irlos export copies them. Of DIR, the folder of a run, the products are listed, with
    what their stages said. Of a recording, FITS, or a folder of recordings: layout, frames, what its
    side-car states, and the command that reduces it or says what is missing.

    \b
    Examples:
      irlos show demo
      irlos show demo/03_calibrate.h5
      irlos show demo/03_calibrate.h5 --json
      irlos show star.fits
    """
    from irlos_pipe.commands.text import product_text, run_text
    from irlos_pipe.product.printed import shown_product, shown_run
    from irlos_pipe.product.runfolder import RunFolder
    from irlos_pipe.readers.fitsfile import has_fits_name

    with readable(product):
        files = product.iterdir() if product.is_dir() else [product]
        recorded = any(has_fits_name(one) and one.is_file() for one in files)
        if recorded and not RunFolder(product).recipe.is_file():
            from irlos_pipe.night.files import found_recordings

            click.echo(found_recordings(product, as_json))
        elif product.is_dir():
            run = shown_run(product)
            click.echo(run.text() if as_json else run_text(run))
        else:
            found = shown_product(product)
            click.echo(found.text() if as_json else product_text(found))


@command()
def compare(
    first: Path = argument("FIRST"),
    second: Path = argument("SECOND"),
    everything: bool = option("--all", "Print all numbers that differ."),
    as_json: bool = options.JSON,
) -> None:
    """Compare two runs: settings, input files, software, all numbers, and which checks passed.

    FIRST and SECOND are folders of runs. A difference is the second less the first, in units and in
    σ, both errors in quadrature; the most significant ones are printed. Of one recording that was
    reduced twice the errors are not independent, and differences should be well below 1 σ.

    \b
    Examples:
      irlos compare reduced/001 reduced/latest
      irlos compare monday tuesday --all
      irlos compare monday tuesday --json > comparison.json
    """
    from irlos_pipe.commands.text import comparison_text
    from irlos_pipe.product.run_table import compare_runs

    with readable(first), readable(second):
        found = compare_runs(first, second)
        click.echo(found.text() if as_json else comparison_text(found, everything))


@command()
def report(
    folder: Path = argument("DIR"),
    figures: bool = option("--figures", "Write every figure to DIR/figures as well."),
    formats: tuple[Literal["pdf", "png", "svg"], ...] = option(
        "--format", "File format of the figures (default: all three). May be repeated."
    ),
) -> None:
    """Write DIR/report.html again from the products of a run.

    \b
    Examples:
      irlos report demo
      irlos report demo --figures --format pdf
    """
    from irlos_pipe.product.runfolder import existing_run, owned_folder

    if formats and not figures:
        raise click.UsageError("--format is that of the figures: give --figures as well")
    with owned_folder(existing_run(folder).path) as run_folder:
        from irlos_pipe.pipeline.resources import available_cpus
        from irlos_pipe.report.build import FORMATS, write_figures, write_report

        with readable(folder):
            click.echo(write_report(run_folder.path, available_cpus()))
            for path in write_figures(run_folder, formats or FORMATS) if figures else ():
                click.echo(path)


@command()
def export(
    product: Path = argument("PRODUCT.h5|DIR"),
    arrays: tuple[str, ...] = option(
        "--array NAME",
        "Array to copy; irlos show PRODUCT.h5 lists the names. May be repeated.",
        shell_complete=completion.arrays,
    ),
    recording: str | None = option(
        "--aot RECORDING",
        "Write this recording of 01_ingest.h5 as an AOT file instead, with a side-car beside it.",
    ),
    output: Path = option("--output FILE", "File to write: .fits, .csv or .sqlite."),
    force: bool = options.REPLACE,
) -> None:
    """Copy arrays out of PRODUCT.h5 into a FITS or CSV file, or tables of the run in DIR.

    A FITS file holds arrays of any shape, one extension each, with the unit in BUNIT and errors in
    extensions of their own. A CSV file holds columns of equal length, or one matrix. Both have a
    header with the origin of the numbers. Of a run, all checks and numbers are written as .csv or
    .sqlite.

    \b
    Examples:
      irlos export demo/03_calibrate.h5 --array zernike_nm --output ncpa.csv
      irlos export demo/01_ingest.h5 --array recordings/calibration/calibration-sky/mean_e --output mean.fits
      irlos export demo/01_ingest.h5 --aot calibration-sky --output aot.fits
      irlos export demo --output demo.sqlite
    """
    from irlos_pipe.product.storage import read_product

    if product.is_dir():
        from irlos_pipe.product.run_table import write_run_table

        if arrays or recording:
            raise click.UsageError(f"{product} is a folder: give a product, or leave --array and --aot out")
        write_run_table(product, output, replace=force)
    elif bool(arrays) == bool(recording):
        raise click.UsageError("give either --array NAME or --aot RECORDING")
    elif recording:
        from irlos_pipe.product.export import write_aot

        write_aot(read_product(product), recording, output, replace=force)
    else:
        from irlos_pipe.product.export import export_arrays

        export_arrays(read_product(product), arrays, output, replace=force)
    click.echo(output)


@command()
def score(
    folder: Path = argument("DIR"),
    truth: Path = option("--truth PATH", "Truth of the recordings: a JSON file, or a folder of them."),
    as_json: bool = options.JSON,
) -> None:
    """Compare the results of the run in DIR with the truth of simulated data.

    The table lists the errors of every calibration method and of the ramp.

    \b
    Examples:
      irlos score sim/run --truth sim/truth
      irlos score sim/run --truth sim/truth --json
    """
    from irlos_pipe.report.score import score_run, score_text

    found = score_run(folder, truth)
    click.echo(found.text() if as_json else score_text(found))
