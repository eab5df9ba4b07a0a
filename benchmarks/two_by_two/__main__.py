"""Run both parts: numbers into ``benchmarks/two_by_two/results.json``, tables into ``docs/two_by_two.md``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path

import click

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
    for name, lines in (("archive", archive.rows(found)), ("comparison", comparison.rows(points))):
        _show(name, list(lines), write_docs)


def _show(name: str, lines: Iterable[str], write_docs: bool) -> None:
    """Print a table, and put it between its markers in the page."""
    table = "\n".join(lines)
    click.echo(table)
    if write_docs:
        block = f"<!-- {name} -->\n{table}\n<!-- end of {name} -->"
        pattern = rf"<!-- {name} -->.*?<!-- end of {name} -->"
        PAGE.write_text(re.sub(pattern, lambda _: block, PAGE.read_text(), flags=re.S))


if __name__ == "__main__":
    main()
