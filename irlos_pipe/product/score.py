"""How far the results of a run are from the truth of simulated data."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.text import aligned
from irlos_pipe.product.product import Product, read_product
from irlos_pipe.product.runfolder import existing_run

NOLLS = tuple(range(2, 31))
Truths = Mapping[str, dict[str, Any]]
Table = list[tuple[str, ...]]


def score_run(run_folder: Path, truth: Path) -> str:
    """Compare the calibration and the ramp of a run with the truth.

    Parameters
    ----------
    run_folder : Path
        Folder of a run.
    truth : Path
        A JSON file, or a folder of them, one per recording and named like it; ``/`` in a name is
        written ``__``, and what stands before ``__`` need not match. ``mean_zernike_nm`` holds the
        time-averaged wavefront without the diversity (Noll: nm RMS), ``ncpa_nm`` its static part.

    Returns
    -------
    str
        A short table.

    Raises
    ------
    InputDataError
        When the run has nothing to compare, or the truth cannot be read or belongs to other recordings.
    """
    paths = existing_run(run_folder).products()
    products = {stage: read_product(path, arrays=False) for stage, path in paths.items()}
    if not {"calibrate", "lift"} & products.keys():
        raise InputDataError(f"{run_folder}: neither 'calibrate' nor 'lift' was run, nothing to compare")
    truths = _read_truths(Path(truth))
    tables = _calibration_table(products, truths), _ramp_table(products, truths)
    if not any(tables):
        raise InputDataError(
            f"{truth}: no truth for {', '.join(_compared(products))}; it holds {', '.join(truths)}"
        )
    return "\n\n".join(aligned(table, numbers=True) for table in tables if table)


# -- calibration -------------------------------------------------------------------------------


def _calibration_table(products: Mapping[str, Product], truths: Truths) -> Table:
    """One row per method; empty without truth for every recording that was fitted."""
    if "calibrate" not in products:
        return []
    rows = _recordings(products, "calibrate")
    found = [_truth_of(row["name"], truths) for row in rows]
    if not found or any(one is None or "mean_zernike_nm" not in one for one in found):
        return []
    each_nm = [_vector(one["mean_zernike_nm"]) for one in found]
    true_nm = np.average(each_nm, axis=0, weights=_frames_used(rows))
    results = products["calibrate"].results
    names = ", ".join(row["name"] for row in rows)
    return [
        (f"calibration ({names})", "error, Noll 2–30", "defocus", "time"),
        *(_method_row(one, true_nm) for one in (results, *results.get("compare", []))),
    ]


def _frames_used(rows: Sequence[dict[str, Any]]) -> list[int]:
    return [row["frames"] - row.get("frames_rejected", 0) for row in rows]


def _method_row(result: dict[str, Any], true_nm: np.ndarray) -> tuple[str, ...]:
    error_nm = _vector(result["zernike_nm"]) - true_nm
    return (
        result["method"],
        f"{np.linalg.norm(error_nm):.1f} nm RMS",
        f"{error_nm[NOLLS.index(4)]:+.1f} nm",
        f"{_number(result.get('seconds')):.1f} s",
    )


def _vector(zernike_nm: Mapping[str, float | None]) -> np.ndarray:
    """Coefficients of Noll 2 to 30; modes that are not there count as zero."""
    return np.array([_number(zernike_nm.get(str(noll), 0.0)) for noll in NOLLS])


# -- ramp --------------------------------------------------------------------------------------


def _ramp_table(products: Mapping[str, Product], truths: Truths) -> Table:
    """Errors of the ramp against what was introduced and against what there was; empty without truth."""
    if "lift" not in products:
        return []
    points = [point for point in products["lift"].results["points"] if _truth_of(point["name"], truths)]
    if not points:
        return []
    estimated, introduced, present = np.array([_ramp_point(point, truths) for point in points]).T
    names = np.array([point["name"] for point in points])
    rows = [
        ("frames against the introduced defocus", _rms(estimated - introduced)),
        ("frames against the true mean defocus", _rms(estimated - present)),
        ("means of recordings against the true mean defocus", _rms(_means(estimated - present, names))),
    ]
    return [
        (f"ramp ({len(set(names))} recordings, {len(points)} frames)", "error"),
        *((name, f"{rms:.1f} nm RMS") for name, rms in rows if math.isfinite(rms)),
    ]


def _means(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Mean of every group of what is known."""
    known = np.isfinite(values)
    return np.array([values[known & (groups == group)].mean() for group in np.unique(groups[known])])


def _ramp_point(point: dict[str, Any], truths: Truths) -> tuple[float, float, float]:
    """Estimated, introduced, and truly present defocus without the NCPA's; NaN for what is not known."""
    truth = _truth_of(point["name"], truths) or {}
    mean_nm, ncpa_nm = (truth.get(key, {}).get("4") for key in ("mean_zernike_nm", "ncpa_nm"))
    return _number(point["defocus_nm"]), _number(point["introduced_nm"]), _number(mean_nm) - _number(ncpa_nm)


def _rms(values: np.ndarray) -> float:
    """RMS of what is known; NaN when nothing is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


# -- truth and recordings ----------------------------------------------------------------------


def _compared(products: Mapping[str, Product]) -> list[str]:
    """Names of the recordings that have results."""
    return [
        row["name"]
        for stage in ("calibrate", "lift")
        if stage in products
        for row in _recordings(products, stage)
    ]


def _recordings(products: Mapping[str, Product], stage: str) -> list[dict[str, Any]]:
    """Rows of ingest that belong to the input of a stage."""
    rows = products["ingest"].results["inputs"] if "ingest" in products else []
    wanted = products[stage].config.get("input")
    return [row for row in rows if row["input"] == wanted and row["role"] != "dark"]


def _read_truths(path: Path) -> dict[str, dict[str, Any]]:
    """Content of the truth files by name of the file without ``.json``."""
    truths = {file.name.removesuffix(".json"): _read_truth(file) for file in _truth_files(path)}
    if not truths:
        raise InputDataError(f"{path}: no *.json in this folder; give the folder of the truth files")
    return truths


def _truth_files(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
    elif path.is_dir():
        yield from sorted(path.glob("*.json"))
    else:
        raise InputDataError(f"{path}: no such file or folder")


def _read_truth(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputDataError(f"{path}: not a readable JSON file ({error})") from error
    if not isinstance(content, dict):
        raise InputDataError(f"{path}: holds a {type(content).__name__}, not an object with mean_zernike_nm")
    return content


def _truth_of(name: str, truths: Truths) -> dict[str, Any] | None:
    """Truth of a recording: by its full name, else by what follows ``__``; None if there is none.

    Raises
    ------
    InputDataError
        When several fit.
    """
    own = name.rpartition("__")[2]
    for wanted in (lambda key: key == name, lambda key: key.rpartition("__")[2] == own):
        fitting = [key for key in truths if wanted(key)]
        if len(fitting) > 1:
            raise InputDataError(
                f"recording '{name}' fits several truth files: {', '.join(fitting)}; "
                "give a folder with one of them"
            )
        if fitting:
            return truths[fitting[0]]
    return None
