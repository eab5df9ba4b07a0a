"""Checks and numbers of a run as one table: in CSV or SQLite, or next to those of another run."""

import csv
import io
import json
import logging
import math
import os
import re
import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import changed_values
from irlos_pipe.files.regular import read_regular
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.printed import Comparison, ModesPair, NumberPair, ValuePair, VersionRow, Versions
from irlos_pipe.product.results import provenance_of, read_run_results
from irlos_pipe.product.runfolder import LOCK_NAME, OF_A_RUN, RunFolder, existing_run, require_free
from irlos_pipe.product.storage import read_product

CHECK_COLUMNS = ("stage", "name", "value", "unit", "low", "high", "passed", "message")
NUMBER_COLUMNS = ("stage", "name", "value", "unit")
KINDS = ("check", "number")
UNIT = re.compile(r"(?:^|[._])(nm2|nm|mas_per_um|mas|arcsec|e2|e|adu|deg|px|hz|m|s|mag)(?=$|\.)")
Row = tuple[Any, ...]

WAVEFRONT = re.compile(r"(.*\.)?zernike_nm\.\d+")
# Values whose errors stand under another name than NAME_sigma, NAME_sigma_UNIT or NAME_error_UNIT.
ERRORS = {
    "zernike_nm": "sigma_nm",
    "defocus_nm": "sigma_nm",
    "ncpa_change_nm": "sigma_nm",
    "parameters": "sigma",
    "shown": "shown_sigma",
    "measured": "error",
}
CALLED = ("name", "recording", "effect", "method")  # keys that name a row of a list; `frame` adds to them
OF_THE_MACHINE = {"seconds"}  # keys that differ between any two runs, and are not compared
LOG = logging.getLogger(__name__)
LATEST = "latest"
NUMBER = re.compile(r"\d{3,}")
DIGITS = 3
OWN = tuple(f"[0-9][0-9][0-9]*/{name}" for name in (*OF_A_RUN, LOCK_NAME))


def write_run_table(folder: Path, path: Path, *, replace: bool = False) -> None:
    """Write every check and every number of the run in `folder` to a ``.csv`` or ``.sqlite`` file at `path`.

    CSV has one table whose first column says ``check`` or ``number``; SQLite has the tables ``checks`` and
    ``numbers``. A number is named as in results.json, ``zernike_nm.4`` in stage ``calibrate``.

    Raises `ConfigurationError` when the file type is unknown, or the file exists and `replace` is False, and
    `InputDataError` when it is not the folder of a run, or its files cannot be read.
    """
    writers = {".csv": _csv, ".sqlite": _sqlite}
    if path.suffix not in writers:
        raise ConfigurationError(f"{path}: unknown file type '{path.suffix}'; use .csv or .sqlite")
    if path.exists() and not replace:
        raise ConfigurationError(f"{path}: exists already; choose another name or give --force")
    run = existing_run(folder)
    checks = [tuple(check.values()) for check in read_checks(run)]
    numbers = [
        (stage, name, value, unit_of(name))
        for stage, tree in read_run_results(run.results).stages.items()
        for name, value in _tree_numbers(tree)
    ]
    write_bytes(path, writers[path.suffix](checks, numbers))


def read_checks(run: RunFolder) -> list[dict[str, Any]]:
    """Return the checks of a `run` as they stand in qc.json; `InputDataError` when it cannot be read."""
    try:
        checks = json.loads(read_regular(run.quality))["checks"]
        return [{column: check[column] for column in CHECK_COLUMNS} for check in checks]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputDataError(f"{run.quality}: cannot be read ({error}); run the recipe again") from error


def _tree_numbers(tree: Any, above: str = "") -> Iterator[tuple[str, float]]:
    """All numbers of a tree with their path; switches are no numbers."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _tree_numbers(value, f"{above}.{key}" if above else str(key))
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            yield from _tree_numbers(value, f"{above}.{index}")
    elif isinstance(tree, (int, float)) and not isinstance(tree, bool) and math.isfinite(tree):
        yield above, tree


def unit_of(name: str) -> str:
    """Return the unit that the last part of a `name` with one ends in; "" without."""
    found = UNIT.findall(name)
    return found[-1].replace("_per_", "/") if found else ""


def _csv(checks: list[Row], numbers: list[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("kind", *CHECK_COLUMNS))
    writer.writerows((KINDS[0], *row[:6], int(row[6]), row[7]) for row in checks)
    writer.writerows((KINDS[1], *row, "", "", "", "") for row in numbers)
    return text.getvalue().encode()


def _sqlite(checks: list[Row], numbers: list[Row]) -> bytes:
    connection = sqlite3.connect(":memory:")
    try:
        for name, columns, rows in (("checks", CHECK_COLUMNS, checks), ("numbers", NUMBER_COLUMNS, numbers)):
            connection.execute(f"CREATE TABLE {name} ({', '.join(columns)})")
            places = ", ".join("?" * len(columns))
            connection.executemany(f"INSERT INTO {name} VALUES ({places})", rows)
        connection.commit()
        return connection.serialize()
    finally:
        connection.close()


# -- two runs side by side: what was asked for, and what came out ------------------------------------

Place = tuple[str, ...]  # of a value in results.json, the stage first


def compare_runs(first: Path, second: Path) -> Comparison:
    """Compare the runs in the folders `first` and `second`.

    Raises `InputDataError` when one of them is not the folder of a run, or cannot be read.
    """
    runs = existing_run(first), existing_run(second)
    one, other = (dict(leaves(read_run_results(run.results).stages)) for run in runs)
    files = _pairs(*map(_files, runs))
    pairs = [(".".join(path), value, other[path]) for path, value in one.items() if path in other]
    numbers = [_number_pair(*pair) for pair in pairs if _are_numbers(*pair[1:])]
    words = [pair for pair in pairs if not _are_numbers(*pair[1:]) and pair[1].value != pair[2].value]
    return Comparison(
        first=str(first),
        second=str(second),
        same_files=not files,
        told=_pairs(*map(_stated, runs)),
        settings=_pairs(*map(settings_of, runs)),
        files=files,
        modes=list(_modes(numbers)),
        numbers=numbers,
        words=[ValuePair(name=name, first=own.value, second=its.value) for name, own, its in words],
        only_first=_only_in(one, other),
        only_second=_only_in(other, one),
        checks=_pairs(*map(_checks, runs)),
    )


def _pairs(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[ValuePair]:
    return [
        ValuePair(name=".".join(path), first=before, second=after)
        for path, (before, after) in changed_values(first, second).items()
    ]


def _stated(run: RunFolder) -> dict[str, Any]:
    """What a run says of itself: recipe, status, and the software of its last product."""
    results = read_run_results(run.results)
    told = {"recipe": results.recipe, "status": results.status}
    made = [provenance_of(read_product(path, arrays=False)) for path in list(run.products().values())[-1:]]
    return told | {"software": made[0].software if made else {}}


def _files(run: RunFolder) -> dict[str, str]:
    made = [provenance_of(read_product(path, arrays=False)) for path in list(run.products().values())[:1]]
    return {file.label: file.sha256 for one in made for file in one.inputs}


def settings_of(run: RunFolder) -> dict[str, Any]:
    """Return the recipe of a `run` without its name and its inputs.

    Raises `InputDataError` when it cannot be read.
    """
    recipe = load_yaml(run.recipe, InputDataError)[0]
    return {key: value for key, value in recipe.items() if key not in ("recipe", "title", "inputs")}


def _checks(run: RunFolder) -> dict[str, str]:
    return {
        f"{one['stage']}: {one['name']}": "passed" if one["passed"] else "failed" for one in read_checks(run)
    }


def _are_numbers(*both: "Leaf") -> bool:
    return all(_is_number(one.value) for one in both)


def _number_pair(path: str, one: "Leaf", other: "Leaf") -> NumberPair:
    stage, _, name = path.partition(".")
    difference, error = other.value - one.value, math.hypot(one.error, other.error)
    return NumberPair(
        stage=stage,
        name=name,
        unit=unit_of(name),
        first=one.value,
        second=other.value,
        first_error=one.error,
        second_error=other.error,
        difference=difference,
        sigmas=difference / error if error > 0 else math.nan,
    )


def _modes(numbers: Iterable[NumberPair]) -> Iterator[ModesPair]:
    """Wavefronts whose coefficients have errors."""
    rows = [one for one in numbers if WAVEFRONT.fullmatch(one.name) and math.isfinite(one.sigmas)]
    for (stage, name), group in groupby(rows, key=lambda one: (one.stage, one.name.rpartition(".")[0])):
        pairs = list(group)
        yield ModesPair(
            stage=stage,
            name=name,
            modes=len(pairs),
            difference_nm=math.hypot(*(one.difference for one in pairs)),
            expected_nm=math.hypot(
                *(error for one in pairs for error in (one.first_error, one.second_error))
            ),
        )


def _only_in(one: "Mapping[Place, Leaf]", other: "Mapping[Place, Leaf]") -> list[str]:
    """What the first has and the second lacks, by the shortest path that the second lacks altogether."""
    known = {path[:length] for path in other for length in range(1, len(path) + 1)}
    missing = {
        next(path[:length] for length in range(1, len(path) + 1) if path[:length] not in known): None
        for path in one
        if path not in other and any(path[:length] not in known for length in range(1, len(path) + 1))
    }
    return [".".join(path) for path in missing]


# -- results as single values with their errors, under names that are the same in another run ----------


@dataclass(frozen=True)
class Leaf:
    """A single value, and its error, NaN without one."""

    value: Any
    error: float = math.nan


def leaves(tree: Any, error: Any = None, above: Place = ()) -> Iterator[tuple[Place, Leaf]]:
    """Yield the path, from `above`, and the value of every leaf of a `tree` of results in the types of JSON.

    A row of a list is named by what it is called, not by its number, so that rows of two runs are matched
    by what they are of. Numbers of a list go by their place; a list of anything else is one value. Errors
    are next to the values, or in a tree `error` of the same form.
    """
    if isinstance(tree, Mapping):
        errors = _errors(tree)
        others = OF_THE_MACHINE.union(*errors.values())
        for key, value in tree.items():
            beside = next((tree[name] for name in errors[key]), None)
            its_error = error.get(key) if isinstance(error, Mapping) else beside
            yield from leaves(value, its_error, (*above, str(key))) if key not in others else ()
    elif isinstance(tree, list) and tree and all(isinstance(row, Mapping) for row in tree):
        for name, row in zip(_names(tree), tree, strict=True):
            yield from leaves(row, None, (*above, name))
    elif isinstance(tree, list) and tree and all(map(_is_number, tree)):
        each = error if isinstance(error, list) and len(error) == len(tree) else [None] * len(tree)
        for index, (value, its_error) in enumerate(zip(tree, each, strict=True)):
            yield from leaves(value, its_error, (*above, str(index)))
    else:
        yield above, Leaf(tree, float(error) if _is_number(error) and _is_number(tree) else math.nan)


def _is_number(value: Any) -> bool:
    """Return whether a value of JSON is a number; switches are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _errors(tree: Mapping[str, Any]) -> dict[str, list[str]]:
    """The keys of a tree that hold the error of another, by that; most have none."""
    found = {}
    for key, value in tree.items():
        stem, _, unit = key.rpartition("_")
        names = [*((ERRORS[key],) if key in ERRORS else ()), f"{key}_sigma"]
        names += [f"{stem}_sigma_{unit}", f"{stem}_error_{unit}"] if stem else []
        alike = isinstance(value, Mapping)
        found[key] = [name for name in names if name in tree and isinstance(tree[name], Mapping) == alike]
    return found


def _names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A name of its own for every row of a list: what it is called, or its number."""
    called = [_called(row) for row in rows]
    counted = Counter(called)
    return [name if name and counted[name] == 1 else str(index) for index, name in enumerate(called)]


def _called(row: Mapping[str, Any]) -> str:
    name = next((str(row[key]) for key in CALLED if isinstance(row.get(key), str)), "")
    return f"{name}[{row['frame']}]" if name and "frame" in row else name


def version_folders(folder: Path) -> list[Path]:
    """Return the folders of the versions in a `folder`, the oldest first; links are not followed."""
    try:
        found = [path for path in folder.iterdir() if NUMBER.fullmatch(path.name) and not path.is_symlink()]
    except OSError:
        return []
    return sorted((path for path in found if path.is_dir()), key=lambda path: int(path.name))


def require_free_for_versions(folder: Path) -> None:
    """Refuse a `folder` with files in it that are no versions, or whose ``latest`` is no link.

    Raises `ConfigurationError` when it cannot hold versions.
    """
    require_free(folder, OWN)
    link = folder / LATEST
    if link.exists() and not link.is_symlink():
        raise ConfigurationError(f"{link}: is no link; remove it, or choose another --output")


def link_latest(folder: Path, version: Path) -> None:
    """Let ``latest`` in a `folder` lead to a `version` in it; at any moment it leads to one or the other.

    Where the link cannot be made, as on a disk without links, a warning names the version.
    """
    temporary = folder / f".{LATEST}.{os.getpid()}"
    try:
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(version.name)
        os.replace(temporary, folder / LATEST)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        LOG.warning(
            "%s: cannot be linked (%s); the newest complete version is %s",
            folder / LATEST,
            error.strerror or error,
            version,
        )


def is_complete(run: RunFolder) -> bool:
    """Return whether a `run` ended with all products of its recipe."""
    try:
        stages = load_yaml(run.recipe, InputDataError)[0]["stages"]
        results = read_run_results(run.results)
    except (InputDataError, KeyError):
        return False
    return not results.error and set(stages) <= set(results.stages)


def versions_in(folder: Path) -> Versions:
    """Return what is known of the versions in a `folder`."""
    paths = version_folders(folder)
    latest = next((path for path in reversed(version_folders(folder)) if is_complete(RunFolder(path))), None)
    pairs = zip([None, *paths], paths, strict=False)
    rows = [_row(path, before, latest=path == latest) for before, path in pairs]
    return Versions(folder=str(folder), versions=rows)


def _row(path: Path, before: Path | None, *, latest: bool) -> VersionRow:
    run = RunFolder(path)
    changed = _changed(before, path) if before else []
    if not is_complete(run):
        return VersionRow(version=path.name, status="incomplete", latest=latest, changed=changed)
    results = read_run_results(run.results)
    made = provenance_of(read_product(list(run.products().values())[-1], arrays=False))
    return VersionRow(
        version=path.name,
        recipe=results.recipe,
        status=results.status,
        latest=latest,
        finished=made.finished,
        software=made.software.get("irlos_pipe", ""),
        changed=changed,
    )


def _changed(before: Path, after: Path) -> list[str]:
    """Settings in which two versions differ; none where one of them cannot be read."""
    try:
        settings = [settings_of(RunFolder(path)) for path in (before, after)]
    except InputDataError:
        return []
    return [".".join(path) for path in changed_values(*settings)]
