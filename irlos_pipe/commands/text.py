"""What commands say of runs and products: where they stand, what they hold, how they differ; and its text."""

import json
import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import yaml

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.conventions.text import aligned, printable, rounded_by_error
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product import printed
from irlos_pipe.product.results import provenance_of
from irlos_pipe.product.runfolder import RunFolder, existing_run, is_standing
from irlos_pipe.product.storage import read_product

CURRENT, OUTDATED = "up to date", "outdated"
FOREIGN, UNKNOWN = "not of this recipe", "cannot be checked"
State = tuple[str, str]  # and why

SHOWN = 20  # numbers of a comparison, unless all are asked for
LONGEST = 60  # characters of a value in a table
SAME = "the same"
SAME_FILES = "the same; the errors are not independent, and noise makes differences of far less than 1 σ"


def _document(parts: Mapping[str, str]) -> str:
    """Parts with their titles; one without a title comes as it is."""
    indented = {title: "\n".join(f"  {line}" for line in text.splitlines()) for title, text in parts.items()}
    return _printable(
        "\n\n".join(f"{title}:\n{indented[title]}" if title else text for title, text in parts.items())
    )


def _printable(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))


def product_text(product: printed.ShownProduct) -> str:
    """Return what a `product` contains: provenance, arrays, results, configuration, QC and log."""
    made = product.provenance
    origin = [
        ("product", f"{product.product}, stage '{product.stage}'"),
        ("made", made.finished),
        ("took", f"{made.seconds} s on {made.machine.host}"),
        ("command", made.command),
        ("software", ", ".join(f"{name} {version}" for name, version in made.software.items())),
        ("inputs", f"{len(made.inputs)} files"),
        ("seed", str(made.seed)),
    ]
    parts = {
        "": aligned(origin),
        "arrays": aligned([_array_row(one) for one in product.arrays]) if product.arrays else "none",
        "results": _yaml(product.results),
        "configuration": _yaml(product.configuration),
        "checks": "\n".join(map(_check_line, product.checks)) or "none",
        "log": "\n".join(product.log) or "empty",
    }
    return _document(parts)


def run_text(run: printed.ShownRun) -> str:
    """Return the products of a `run`, each with what its stage said, and the names of the other files."""
    head = ": ".join(filter(None, (run.run, ", ".join(filter(None, (run.recipe, run.status))))))
    rows: list[tuple[str, ...]] = [("product", "arrays", "QC", "")]
    for one in run.products:
        if one.problem:
            rows.append((one.product, "-", "-", one.problem))
            continue
        first, *more = one.summary or [""]
        rows.append((one.product, str(one.arrays), f"{one.passed}/{one.checks}", first))
        rows += [("", "", "", line) for line in more]
    files = f"other files: {', '.join(run.files)}"
    return _printable("\n".join(filter(None, (head, run.notice, aligned(rows), files))))


def run_status(folder: Path) -> printed.RunStatus:
    """Return where each product of the run in `folder` stands.

    Raises `InputDataError` when `folder` holds no run.
    """
    run = existing_run(folder)
    states = _states(run)
    current = all(state == CURRENT for state, _ in states.values())
    there = [path.name for path in run.product_files]
    rows = [_row(run.path / name, *states.pop(name, (FOREIGN, ""))) for name in there]
    rows += [
        printed.ProductRow(product=name, state=state, reason=why) for name, (state, why) in states.items()
    ]
    return printed.RunStatus(run=str(folder), current=current, products=rows)


def _states(run: RunFolder) -> dict[str, State]:
    """State of each product of the run's recipe by file name."""
    if is_standing(run):
        stages = load_yaml(run.recipe)[0]["stages"]
        return {run.product(position, stage).name: (CURRENT, "") for position, stage in enumerate(stages, 1)}
    # late: a plan needs the modules of all stages
    from irlos_pipe.pipeline.plan import Selection, plan_run
    from irlos_pipe.recipe import load_recipe

    try:
        _, steps = plan_run(load_recipe(run.recipe), run.path, Selection())
    except IrlosError as error:
        reason = str(error).splitlines()[0]
        return {path.name: (UNKNOWN, reason) for path in run.product_files}
    return {step.path.name: (CURRENT, "") if step.current else (OUTDATED, step.reason) for step in steps}


def _row(path: Path, state: str, reason: str) -> printed.ProductRow:
    told = {"product": path.name, "state": state, "reason": reason}
    try:
        product = read_product(path, arrays=False)
    except InputDataError:
        return printed.ProductRow(**told)
    return printed.ProductRow(
        **told,
        checks=len(product.checks),
        passed=sum(check.passed for check in product.checks),
        finished=provenance_of(product).finished,
    )


def status_text(status: printed.RunStatus) -> str:
    """Return one line per product of a run: whether it is up to date, its QC and when it was made."""
    rows = [("product", "state", "QC", "finished")]
    for one in status.products:
        quality = "-" if one.checks is None else f"{one.passed}/{one.checks}"
        state = f"{one.state}: {one.reason}" if one.reason else one.state
        rows.append((one.product, state, quality, one.finished or "-"))
    return aligned(rows)


def versions_text(found: printed.Versions) -> str:
    """Return one line per version of a reduction: status, software, what was changed in its settings."""
    rows = [("version", "recipe", "status", "finished", "software", "", "settings that were changed")]
    for one in found.versions:
        latest = "latest" if one.latest else ""
        told = (one.version, one.recipe or "-", one.status, one.finished or "-", one.software or "-")
        rows.append((*told, latest, ", ".join(one.changed)))
    return aligned(rows)


def _array_row(array: printed.ArrayRow) -> tuple[str, ...]:
    shape = "x".join(map(str, array.shape)) or "scalar"
    error = "with error" if array.with_error else ""
    return array.name, shape, array.type, array.unit or "-", error, array.description


def _check_line(check: printed.CheckRow) -> str:
    low = "-inf" if math.isnan(check.low) else f"{check.low:g}"
    high = "inf" if math.isnan(check.high) else f"{check.high:g}"
    verdict = "passed" if check.passed else "FAILED"
    return f"{verdict}  {check.name} = {check.value:g} {check.unit} [{low} ... {high}]  {check.message}"


def _yaml(content: dict) -> str:
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None).rstrip()


def comparison_text(found: printed.Comparison, everything: bool) -> str:
    """Return what was `found` to differ between two runs: `everything`, or the numbers that matter most."""
    differ = [one for one in found.numbers if one.difference != 0]
    most = sorted(differ, key=_rank, reverse=True)
    files = [f"{one.name}: {_change(one)}" for one in found.files]
    wavefronts = [
        (
            f"{one.stage} {one.name}",
            f"{one.modes} modes",
            f"{one.difference_nm:.1f} nm RMS between them",
            f"{one.expected_nm:.1f} nm RMS from both errors",
        )
        for one in found.modes
    ]
    parts = {
        "runs": aligned([("first", found.first), ("second", found.second), *_rows(found.told)]),
        "settings": _table(found.settings),
        "input files": SAME_FILES if found.same_files else "\n".join(files),
        "wavefronts": aligned(wavefronts) if wavefronts else "",
        f"numbers ({len(differ)} of {len(found.numbers)} differ)": _numbers_text(most, everything),
        "words": _table(found.words),
        f"only in {found.first}": _gathered(found.only_first),
        f"only in {found.second}": _gathered(found.only_second),
        "checks": _table(found.checks) or SAME,
    }
    return _document({title: part for title, part in parts.items() if part})


def _rank(one: printed.NumberPair) -> tuple[float, float]:
    """Most significant first; without errors, by the relative difference, behind all others."""
    if math.isfinite(one.sigmas):
        return abs(one.sigmas), 0.0
    size = max(abs(one.first), abs(one.second))
    return -1.0, abs(one.difference) / size if size > 0 else 0.0


def _numbers_text(differ: Sequence[printed.NumberPair], everything: bool) -> str:
    if not differ:
        return SAME
    shown = differ if everything else differ[:SHOWN]
    head = ("stage", "number", "first", "second", "difference", "")
    more = [f"… and {len(differ) - SHOWN} more: --all shows them"] if len(differ) > len(shown) else []
    return "\n".join([aligned([head, *map(_number_row, shown)]), *more])


def _number_row(one: printed.NumberPair) -> tuple[str, ...]:
    return (
        one.stage,
        one.name,
        rounded_by_error(one.first, one.first_error, ".6g"),
        rounded_by_error(one.second, one.second_error, ".6g"),
        f"{one.difference:+.3g} {one.unit}".rstrip(),
        f"{one.sigmas:+.1f} σ" if math.isfinite(one.sigmas) else "",
    )


def _gathered(names: Sequence[str]) -> str:
    """Names in a line each; entries of one table that go by numbers in one line."""
    lines = []
    for table, group in groupby(names, key=_table_of):
        found = list(group)
        first, last = (found[end].removeprefix(f"{table}.") for end in (0, -1))
        lines += [f"{table}.{first} … {last}"] if table and len(found) > 1 else found
    return "\n".join(lines)


def _table_of(name: str) -> str:
    """The table that an entry that goes by a number belongs to; nothing for any other."""
    table, _, entry = name.rpartition(".")
    return table if entry.isdigit() else ""


def _change(one: printed.ValuePair) -> str:
    return "only in second" if one.first is None else "only in first" if one.second is None else "differs"


def _table(pairs: Sequence[printed.ValuePair]) -> str:
    return aligned(_rows(pairs)) if pairs else ""


def _rows(pairs: Sequence[printed.ValuePair]) -> list[tuple[str, str]]:
    return [(one.name, f"{_shown(one.first)} → {_shown(one.second)}") for one in pairs]


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else "none" if value is None else json.dumps(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"
