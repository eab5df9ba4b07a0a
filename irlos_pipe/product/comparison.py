"""Two runs side by side: what was asked for, and what came out."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.json import changed_values
from irlos_pipe.files.regular import read_regular
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.compared import Comparison, ModesPair, NumberPair, ValuePair
from irlos_pipe.product.leaves import Leaf, is_number, leaves
from irlos_pipe.product.results import provenance_of, read_run_results
from irlos_pipe.product.run_table import unit_of
from irlos_pipe.product.runfolder import RunFolder, existing_run
from irlos_pipe.product.storage import read_product

WAVEFRONT = re.compile(r"(.*\.)?zernike_nm\.\d+")
Values = dict[tuple[str, ...], Leaf]  # by path, the stage first


def compare_runs(first: Path, second: Path) -> Comparison:
    """Compare two runs.

    Parameters
    ----------
    first, second : Path
        Folders of runs.

    Raises
    ------
    InputDataError
        When one of them is not the folder of a run, or cannot be read.
    """
    runs = existing_run(first), existing_run(second)
    one, other = (_values(run) for run in runs)
    files = _pairs(*map(_files, runs))
    numbers = list(_numbers(one, other))
    return Comparison(
        first=str(first),
        second=str(second),
        same_files=not files,
        told=_pairs(*map(_told, runs)),
        settings=_pairs(*map(settings_of, runs)),
        files=files,
        modes=list(_modes(numbers)),
        numbers=numbers,
        words=list(_words(one, other)),
        only_first=_only_in(one, other),
        only_second=_only_in(other, one),
        checks=_pairs(*map(_checks, runs)),
    )


def _pairs(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[ValuePair]:
    """What differs between two mappings, nested to any depth."""
    return [
        ValuePair(name=".".join(path), first=before, second=after)
        for path, (before, after) in changed_values(first, second).items()
    ]


def _values(run: RunFolder) -> Values:
    return dict(leaves(read_run_results(run.results).stages))


def _told(run: RunFolder) -> dict[str, Any]:
    """What a run says of itself: recipe, status, and the software of its last product."""
    results = read_run_results(run.results)
    told = {"recipe": results.recipe, "status": results.status}
    made = [provenance_of(read_product(path, arrays=False)) for path in list(run.products().values())[-1:]]
    return told | {"software": made[0].software if made else {}}


def _files(run: RunFolder) -> dict[str, str]:
    """Checksums of the files that went in, by label."""
    made = [provenance_of(read_product(path, arrays=False)) for path in list(run.products().values())[:1]]
    return {file.label: file.sha256 for one in made for file in one.inputs}


def settings_of(run: RunFolder) -> dict[str, Any]:
    """Return the recipe of a `run` without its name and its inputs.

    Raises
    ------
    InputDataError
        When it cannot be read.
    """
    recipe = load_yaml(run.recipe, InputDataError)[0]
    return {key: value for key, value in recipe.items() if key not in ("recipe", "title", "inputs")}


def _checks(run: RunFolder) -> dict[str, str]:
    try:
        checks = json.loads(read_regular(run.quality))["checks"]
        return {f"{one['stage']}: {one['name']}": "passed" if one["passed"] else "failed" for one in checks}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputDataError(f"{run.quality}: cannot be read ({error}); run the recipe again") from error


def _numbers(first: Values, second: Values) -> Iterator[NumberPair]:
    """All numbers that both runs have."""
    for path, one in first.items():
        other = second.get(path)
        if other is not None and is_number(one.value) and is_number(other.value):
            yield _number(path, one, other)


def _number(path: tuple[str, ...], first: Leaf, second: Leaf) -> NumberPair:
    stage, *rest = path
    difference = second.value - first.value
    both = math.hypot(first.error, second.error)
    return NumberPair(
        stage=stage,
        name=".".join(rest),
        unit=unit_of(".".join(rest)),
        first=first.value,
        second=second.value,
        first_error=first.error,
        second_error=second.error,
        difference=difference,
        sigmas=difference / both if both > 0 else math.nan,
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


def _words(first: Values, second: Values) -> Iterator[ValuePair]:
    """What is no number, and differs."""
    for path, one in first.items():
        other = second.get(path)
        both = other is not None and is_number(one.value) and is_number(other.value)
        if other is not None and not both and one.value != other.value:
            yield ValuePair(name=".".join(path), first=one.value, second=other.value)


def _only_in(one: Values, other: Values) -> list[str]:
    """What the first has and the second lacks, by the shortest path that the second lacks altogether."""
    known = {path[:length] for path in other for length in range(1, len(path) + 1)}
    missing = {
        next(path[:length] for length in range(1, len(path) + 1) if path[:length] not in known): None
        for path in one
        if path not in other and any(path[:length] not in known for length in range(1, len(path) + 1))
    }
    return [".".join(path) for path in missing]
