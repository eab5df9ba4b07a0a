"""What commands print of runs and products, as text."""

from __future__ import annotations

import math

import yaml

from irlos_pipe.conventions.text import aligned, printable
from irlos_pipe.product.printed import (
    ArrayRow,
    CheckRow,
    HeldProduct,
    ProductRow,
    RunStatus,
    ShownProduct,
    ShownRun,
    Versions,
)


def product_text(product: ShownProduct) -> str:
    """Return what a `product` contains: provenance, arrays, results, configuration, QC and log."""
    parts = {
        "": _origin(product),
        "arrays": aligned([_array_row(one) for one in product.arrays]) if product.arrays else "none",
        "results": _yaml(product.results),
        "configuration": _yaml(product.configuration),
        "checks": "\n".join(map(_check_line, product.checks)) or "none",
        "log": "\n".join(product.log) or "empty",
    }
    text = "\n\n".join(_titled(title, text) for title, text in parts.items())
    return "\n".join(map(printable, text.split("\n")))


def run_text(run: ShownRun) -> str:
    """Return the products of a `run`, each with what its stage said, and the names of the other files."""
    head = ": ".join(filter(None, (run.run, ", ".join(filter(None, (run.recipe, run.status))))))
    rows: list[tuple[str, ...]] = [("product", "arrays", "QC", "")]
    for one in run.products:
        rows += _held_rows(one)
    files = f"other files: {', '.join(run.files)}"
    lines = "\n".join(filter(None, (head, run.notice, aligned(rows), files))).split("\n")
    return "\n".join(map(printable, lines))


def _held_rows(one: HeldProduct) -> list[tuple[str, ...]]:
    if one.problem:
        return [(one.product, "-", "-", one.problem)]
    first, *more = one.summary or [""]
    return [
        (one.product, str(one.arrays), f"{one.passed}/{one.checks}", first),
        *(("", "", "", line) for line in more),
    ]


def status_text(status: RunStatus) -> str:
    """Return one line per product of a run: whether it is up to date, its QC and when it was made."""
    rows = [("product", "state", "QC", "finished")]
    return aligned([*rows, *map(_status_row, status.products)])


def versions_text(found: Versions) -> str:
    """Return one line per version of a reduction: status, software, what was changed in its settings."""
    rows = [("version", "recipe", "status", "finished", "software", "", "settings that were changed")]
    for one in found.versions:
        latest = "latest" if one.latest else ""
        told = (one.version, one.recipe or "-", one.status, one.finished or "-", one.software or "-")
        rows.append((*told, latest, ", ".join(one.changed)))
    return aligned(rows)


def _status_row(row: ProductRow) -> tuple[str, ...]:
    quality = "-" if row.checks is None else f"{row.passed}/{row.checks}"
    state = f"{row.state}: {row.reason}" if row.reason else row.state
    return row.product, state, quality, row.finished or "-"


def _origin(product: ShownProduct) -> str:
    made = product.provenance
    software = ", ".join(f"{name} {version}" for name, version in made.software.items())
    rows = [
        ("product", f"{product.product}, stage '{product.stage}'"),
        ("made", made.finished),
        ("took", f"{made.seconds} s on {made.machine.host}"),
        ("command", made.command),
        ("software", software),
        ("inputs", f"{len(made.inputs)} files"),
        ("seed", str(made.seed)),
    ]
    return aligned(rows)


def _array_row(array: ArrayRow) -> tuple[str, ...]:
    shape = "x".join(map(str, array.shape)) or "scalar"
    error = "with error" if array.with_error else ""
    return array.name, shape, array.type, array.unit or "-", error, array.description


def _check_line(check: CheckRow) -> str:
    low = "-inf" if math.isnan(check.low) else f"{check.low:g}"
    high = "inf" if math.isnan(check.high) else f"{check.high:g}"
    verdict = "passed" if check.passed else "FAILED"
    return f"{verdict}  {check.name} = {check.value:g} {check.unit} [{low} ... {high}]  {check.message}"


def _yaml(content: dict) -> str:
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None).rstrip()


def _titled(title: str, text: str) -> str:
    return f"{title}:\n" + "\n".join(f"  {line}" for line in text.splitlines()) if title else text
