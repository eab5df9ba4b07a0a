"""How far the results of a run are from the truth of simulated data."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.modes import DEFOCUS, REPORTED_NOLLS, REPORTED_TEXT, TIP_TILT
from irlos_pipe.conventions.text import aligned, and_more
from irlos_pipe.product.printed import CalibrationScore, MethodScore, RampScore, Score
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import ByNoll, ResultsPart, results_of
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import read_product
from irlos_pipe.stages.calibrate.stage import CalibrateResults, Estimate
from irlos_pipe.stages.ingest.stage import IngestResults, RecordingRow
from irlos_pipe.stages.lift.stage import LiftResults, Point


class Truth(ResultsPart):
    """What a simulation states of a recording; further keys are not used here."""

    mean_zernike_nm: ByNoll | None = None  # time-averaged wavefront without the diversity (Noll: nm RMS)
    ncpa_nm: ByNoll = {}  # its static part


Truths = Mapping[str, Truth]


def score_run(run_folder: Path, truth: Path) -> Score:
    """Compare the calibration and the ramp of a run with the truth.

    The `truth` is a JSON file, or a folder of them, one per recording and named like it; ``/`` in a name is
    written ``__``, and what stands before ``__`` need not match. Its keys are those of `Truth`.

    Raises `InputDataError` when the run has nothing to compare, or the truth cannot be read or belongs to
    other recordings.
    """
    paths = existing_run(run_folder).products()
    products = {stage: read_product(path, arrays=False) for stage, path in paths.items()}
    compared = [products[stage] for stage in ("calibrate", "lift") if stage in products]
    if not compared:
        raise InputDataError(f"{run_folder}: neither 'calibrate' nor 'lift' was run, nothing to compare")
    truths = _read_truths(Path(truth))
    calibration, ramp = _calibration_score(products, truths), _ramp_score(products, truths)
    if calibration is None and ramp is None:
        names = [row.name for one in compared for row in _recordings_of(one, products)]
        raise InputDataError(f"{truth}: {_why_not(names, truths)}")
    return Score(run=str(run_folder), calibration=calibration, ramp=ramp)


def _why_not(names: list[str], truths: Truths) -> str:
    """Why nothing can be compared: no file for a recording, or one without the wavefront."""
    without = [name for name in names if _truth_of(name, truths) is None]
    if without:
        held = list(truths)
        return f"no truth for {without[0]}{and_more(without)}; it holds {held[0]}{and_more(held)}"
    return f"the truth of {names[0]}{and_more(names)} has no mean_zernike_nm (mean wavefront, Noll: nm RMS)"


def _recordings_of(product: Product, products: Mapping[str, Product]) -> list[RecordingRow]:
    """Recordings of the recipe input that a stage worked on."""
    rows = results_of(IngestResults, products["ingest"]).inputs if "ingest" in products else []
    return [row for row in rows if row.input == product.config.get("input") and row.role != "dark"]


# -- calibration -------------------------------------------------------------------------------


def _calibration_score(products: Mapping[str, Product], truths: Truths) -> CalibrationScore | None:
    """One row per method; None without truth for every recording that was fitted."""
    if "calibrate" not in products:
        return None
    results = results_of(CalibrateResults, products["calibrate"])
    rows = _recordings_of(products["calibrate"], products)
    found = [_truth_of(row.name, truths) for row in rows]
    means = [one.mean_zernike_nm for one in found if one and one.mean_zernike_nm is not None]
    statics = [one.ncpa_nm for one in found if one and one.ncpa_nm]
    if not rows or len(means) < len(rows):
        return None
    known = len(statics) == len(rows)

    def over_frames(each: Iterable[Mapping[int, float]]) -> np.ndarray:
        return np.average([_vector(one) for one in each], axis=0, weights=[row.frames_used for row in rows])

    true_nm, static_nm = over_frames(means), over_frames(statics) if known else None
    return CalibrationScore(
        recordings=[row.name for row in rows],
        static_known=known,
        methods=[_method_score(one, true_nm, static_nm) for one in (results, *results.compare)],
    )


def _method_score(estimate: Estimate, true_nm: np.ndarray, static_nm: np.ndarray | None) -> MethodScore:
    """Errors in the reported modes: of the mean wavefront, and without tip and tilt of the static one."""
    value_nm, sigma_nm = _vector(estimate.zernike_nm), _vector(estimate.sigma_nm)
    error_nm, against_static = value_nm - true_nm, {}
    if static_nm is not None:
        optics = np.array([noll not in TIP_TILT for noll in REPORTED_NOLLS])
        own_nm, quoted = value_nm - static_nm, optics & (sigma_nm > 0)
        pull_rms = _rms(own_nm[quoted] / sigma_nm[quoted])
        against_static = {"static_error_nm": float(np.linalg.norm(own_nm[optics])), "pull_rms": pull_rms}
    return MethodScore(
        method=estimate.method,
        error_nm=float(np.linalg.norm(error_nm)),
        defocus_error_nm=float(error_nm[REPORTED_NOLLS.index(DEFOCUS)]),
        seconds=estimate.seconds,
        **against_static,
    )


def _vector(zernike_nm: Mapping[int, float]) -> np.ndarray:
    """Coefficients of the reported modes; modes that are not there count as zero."""
    return np.array([zernike_nm.get(noll, 0.0) for noll in REPORTED_NOLLS])


# -- ramp --------------------------------------------------------------------------------------


def _ramp_score(products: Mapping[str, Product], truths: Truths) -> RampScore | None:
    """Errors of the ramp against the introduced and against the present defocus; None without truth."""
    points = results_of(LiftResults, products["lift"]).points if "lift" in products else []
    known: list[tuple[Point, Truth]] = [
        (point, truth) for point in points if (truth := _truth_of(point.name, truths))
    ]
    if not known:
        return None
    estimated = np.array([point.defocus_nm for point, _ in known])
    mean_nm, ncpa_nm = (  # NaN where either is not known
        np.array([(values or {}).get(DEFOCUS, math.nan) for values in of_all])
        for of_all in zip(*((truth.mean_zernike_nm, truth.ncpa_nm) for _, truth in known), strict=True)
    )
    error_nm = estimated - (mean_nm - ncpa_nm)
    names, finite = np.array([point.name for point, _ in known]), np.isfinite(error_nm)
    means = [error_nm[finite & (names == name)].mean() for name in np.unique(names[finite])]
    return RampScore(
        recordings=len(set(names)),
        frames=len(known),
        against_introduced_nm=_rms(estimated - [point.introduced_nm for point, _ in known]),
        against_true_nm=_rms(error_nm),
        means_against_true_nm=_rms(np.array(means)),
    )


def _rms(values: np.ndarray) -> float:
    """RMS of what is known; NaN when nothing is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


# -- truth -------------------------------------------------------------------------------------


def _read_truths(path: Path) -> dict[str, Truth]:
    """Content of the truth files by name of the file without ``.json``."""
    if not path.is_file() and not path.is_dir():
        raise InputDataError(f"{path}: no such file or folder")
    files = [path] if path.is_file() else sorted(path.glob("*.json"))
    if not files:
        raise InputDataError(f"{path}: no *.json in this folder; give the folder of the truth files")
    return {file.name.removesuffix(".json"): _read_truth(file) for file in files}


def _read_truth(path: Path) -> Truth:
    try:
        content = json.loads(path.read_text())
        if not isinstance(content, dict):
            kind = type(content).__name__
            raise InputDataError(f"{path}: holds a {kind}, not an object with mean_zernike_nm")
        return Truth.model_validate(content)
    except ValidationError as error:
        key = ".".join(map(str, error.errors()[0]["loc"]))
        raise InputDataError(f"{path}: {key}: {error.errors()[0]['msg']}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputDataError(f"{path}: not a readable JSON file ({error})") from error


def _truth_of(name: str, truths: Truths) -> Truth | None:
    """Truth of a recording: by its full name, else by what follows ``__``; None if there is none.

    Raises `InputDataError` when several fit.
    """
    own = name.rpartition("__")[2]
    fitting = [key for key in truths if key == name] or [
        key for key in truths if key.rpartition("__")[2] == own
    ]
    if len(fitting) > 1:
        raise InputDataError(
            f"recording '{name}' fits several truth files: {', '.join(fitting)}; "
            "give a folder with one of them"
        )
    return truths[fitting[0]] if fitting else None


# -- as text -----------------------------------------------------------------------------------


def score_text(score: Score) -> str:
    """Return a table for the calibration and one for the ramp of a `score`."""
    tables: list[list[tuple[str, ...]]] = []
    if calibration := score.calibration:
        columns = {
            f"calibration ({', '.join(calibration.recordings)})": "{0.method}",
            f"error, {REPORTED_TEXT}": "{0.error_nm:.1f} nm RMS",
            "defocus": "{0.defocus_error_nm:+.1f} nm",
            "time": "{0.seconds:.1f} s",
        }
        if calibration.static_known:
            columns |= {
                "against the static modes": "{0.static_error_nm:.1f} nm RMS",
                "its pulls": "{0.pull_rms:.2f}",
            }
        cells = [tuple(cell.format(one) for cell in columns.values()) for one in calibration.methods]
        tables.append([tuple(columns), *cells])
    if ramp := score.ramp:
        errors = {
            "frames against the introduced defocus": ramp.against_introduced_nm,
            "frames against the true mean defocus": ramp.against_true_nm,
            "means of recordings against the true mean defocus": ramp.means_against_true_nm,
        }
        head = f"ramp ({ramp.recordings} recordings, {ramp.frames} frames)"
        known = [(name, f"{rms:.1f} nm RMS") for name, rms in errors.items() if math.isfinite(rms)]
        tables.append([(head, "error"), *known])
    return "\n\n".join(aligned(table, numbers=True) for table in tables)
