"""Run both parts: numbers into ``benchmarks/two_by_two/results.json``, tables into ``docs/two_by_two.md``."""

from __future__ import annotations

import json
from pathlib import Path

import click

from benchmarks.pages import put
from benchmarks.two_by_two import archive, comparison

RESULTS = Path(__file__).parent / "results.json"
PAGE = Path(__file__).parents[2] / "docs" / "two_by_two.md"
MAGS = [10.0, 12.0, 14.0, 15.0, 16.0, 17.0, 18.0, 19.0]


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--files", default=20, show_default=True, help="Files of the archive.")
@click.option("--realisations", default=60, show_default=True, help="Frames per magnitude.")
@click.option("--write-docs", is_flag=True, help="Put the tables into docs/two_by_two.md.")
def main(folder: Path, files: int, realisations: int, write_docs: bool) -> None:
    """Simulate and reduce an archive in FOLDER, and compare three ways to measure defocus."""
    found = archive.measured_archive(folder, files, report=lambda one: click.echo(one))
    points = comparison.compared(MAGS, realisations, exposure_s=1.0, seed=22)
    results = {"archive": archive.as_json(found), "comparison": comparison.as_json(points)}
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    tables = {
        "archive": "\n".join(archive.rows(found)),
        "comparison": "\n".join(comparison.rows(points)),
    }
    click.echo("\n".join(tables.values()))
    if write_docs:
        put(PAGE, tables)


if __name__ == "__main__":
    main()
