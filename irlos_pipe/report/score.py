"""How far the results of a run are from the truth of simulated data."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.modes import DEFOCUS, REPORTED_NOLLS, TIP_TILT
from irlos_pipe.conventions.text import and_more
from irlos_pipe.product.printed import CalibrationScore, MethodScore, RampScore, Score
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import ByNoll, ResultsPart, results_of
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import read_product
from irlos_pipe.stages.calibrate.results import CalibrateResults, Estimate
from irlos_pipe.stages.ingest.results import IngestResults, RecordingRow
from irlos_pipe.stages.lift.results import LiftResults, Point


class Truth(ResultsPart):
    """What a simulation states of a recording; further keys are not used here.

    Attributes
    ----------
    mean_zernike_nm : dict of int to float or None
        Time-averaged wavefront without the diversity (Noll: nm RMS).
    ncpa_nm : dict of int to float
        Its static part.
    """

    mean_zernike_nm: ByNoll | None = None
    ncpa_nm: ByNoll = {}

    @property
    def defocus_beyond_ncpa_nm(self) -> float:
        """Mean defocus without that of the NCPAs; NaN where either is not known."""
        mean_nm = (self.mean_zernike_nm or {}).get(DEFOCUS, math.nan)
        return mean_nm - self.ncpa_nm.get(DEFOCUS, math.nan)


Truths = Mapping[str, Truth]


def score_run(run_folder: Path, truth: Path) -> Score:
    """Compare the calibration and the ramp of a run with the truth.

    Parameters
    ----------
    run_folder : Path
        Folder of a run.
    truth : Path
        A JSON file, or a folder of them, one per recording and named like it; ``/`` in a name is
        written ``__``, and what stands before ``__`` need not match. Its keys are those of `Truth`.

    Returns
    -------
    Score

    Raises
    ------
    InputDataError
        When the run has nothing to compare, or the truth cannot be read or belongs to other recordings.
    """
    run, truths = _read_scored(run_folder), _read_truths(Path(truth))
    calibration, ramp = _calibration_score(run, truths), _ramp_score(run, truths)
    if calibration is None and ramp is None:
        raise InputDataError(f"{truth}: {_why_not(run, truths)}")
    return Score(run=str(run_folder), calibration=calibration, ramp=ramp)


def _why_not(run: _Scored, truths: Truths) -> str:
    """Why nothing can be compared: no file for a recording, or one without the wavefront."""
    names = [row.name for row in (*run.calibrated, *run.of_the_ramp)]
    without = [name for name in names if _truth_of(name, truths) is None]
    if without:
        held = list(truths)
        return f"no truth for {without[0]}{and_more(without)}; it holds {held[0]}{and_more(held)}"
    return f"the truth of {names[0]}{and_more(names)} has no mean_zernike_nm (mean wavefront, Noll: nm RMS)"


@dataclass(frozen=True)
class _Scored:
    """What of a run is compared; None for a stage that was not run.

    Attributes
    ----------
    calibrated, of_the_ramp : list of RecordingRow
        Recordings that went into the calibration and into the ramp.
    """

    calibration: CalibrateResults | None
    ramp: LiftResults | None
    calibrated: list[RecordingRow]
    of_the_ramp: list[RecordingRow]


def _read_scored(folder: Path) -> _Scored:
    paths = existing_run(folder).products()
    products = {stage: read_product(path, arrays=False) for stage, path in paths.items()}
    calibrate, lift = products.get("calibrate"), products.get("lift")
    if calibrate is None and lift is None:
        raise InputDataError(f"{folder}: neither 'calibrate' nor 'lift' was run, nothing to compare")
    rows = results_of(IngestResults, products["ingest"]).inputs if "ingest" in products else []
    return _Scored(
        results_of(CalibrateResults, calibrate) if calibrate else None,
        results_of(LiftResults, lift) if lift else None,
        _recordings_of(calibrate, rows),
        _recordings_of(lift, rows),
    )


def _recordings_of(product: Product | None, rows: Sequence[RecordingRow]) -> list[RecordingRow]:
    """Recordings of the recipe input that a stage worked on."""
    wanted = product.config.get("input") if product else None
    return [row for row in rows if product and row.input == wanted and row.role != "dark"]


# -- calibration -------------------------------------------------------------------------------


def _calibration_score(run: _Scored, truths: Truths) -> CalibrationScore | None:
    """One row per method; None without truth for every recording that was fitted."""
    rows, results = run.calibrated, run.calibration
    found = [truth.mean_zernike_nm if (truth := _truth_of(row.name, truths)) else None for row in rows]
    each_nm = [_vector(mean_nm) for mean_nm in found if mean_nm is not None]
    if results is None or not rows or len(each_nm) < len(rows):
        return None
    weights = [row.frames_used for row in rows]
    true_nm = np.average(each_nm, axis=0, weights=weights)
    statics = [truth.ncpa_nm for row in rows if (truth := _truth_of(row.name, truths)) and truth.ncpa_nm]
    known = len(statics) == len(rows)
    static_nm = np.average([_vector(one) for one in statics], axis=0, weights=weights) if known else None
    return CalibrationScore(
        recordings=[row.name for row in rows],
        static_known=known,
        methods=[_method_score(one, true_nm, static_nm) for one in (results, *results.compare)],
    )


def _method_score(estimate: Estimate, true_nm: np.ndarray, static_nm: np.ndarray | None) -> MethodScore:
    """Errors in the reported modes against the mean wavefront, and against the static modes."""
    error_nm = _vector(estimate.zernike_nm) - true_nm
    static_error_nm, pull_rms = _against_static(estimate, static_nm)
    return MethodScore(
        method=estimate.method,
        error_nm=float(np.linalg.norm(error_nm)),
        defocus_error_nm=float(error_nm[REPORTED_NOLLS.index(DEFOCUS)]),
        seconds=estimate.seconds,
        static_error_nm=static_error_nm,
        pull_rms=pull_rms,
    )


def _against_static(estimate: Estimate, static_nm: np.ndarray | None) -> tuple[float, float]:
    """RMS error without tip and tilt, and its RMS over the quoted errors; NaN where the truth has none."""
    if static_nm is None:
        return math.nan, math.nan
    optics = np.array([noll not in TIP_TILT for noll in REPORTED_NOLLS])
    error_nm, sigma_nm = _vector(estimate.zernike_nm) - static_nm, _vector(estimate.sigma_nm)
    with np.errstate(divide="ignore", invalid="ignore"):
        pull = _rms((error_nm / sigma_nm)[optics & (sigma_nm > 0)])
    return float(np.linalg.norm(error_nm[optics])), pull


def _vector(zernike_nm: Mapping[int, float]) -> np.ndarray:
    """Coefficients of the reported modes; modes that are not there count as zero."""
    return np.array([zernike_nm.get(noll, 0.0) for noll in REPORTED_NOLLS])


# -- ramp --------------------------------------------------------------------------------------


def _ramp_score(run: _Scored, truths: Truths) -> RampScore | None:
    """Errors of the ramp against the introduced and against the present defocus; None without truth."""
    points = run.ramp.points if run.ramp else []
    known = [(point, truth) for point in points if (truth := _truth_of(point.name, truths))]
    if not known:
        return None
    estimated, introduced, present = np.array([_defocus_nm(*one) for one in known]).T
    names = np.array([point.name for point, _ in known])
    return RampScore(
        recordings=len(set(names)),
        frames=len(known),
        against_introduced_nm=_rms(estimated - introduced),
        against_true_nm=_rms(estimated - present),
        means_against_true_nm=_rms(_means(estimated - present, names)),
    )


def _defocus_nm(point: Point, truth: Truth) -> tuple[float, float, float]:
    """Estimated, introduced, and truly present defocus without that of the NCPAs."""
    return point.defocus_nm, point.introduced_nm, truth.defocus_beyond_ncpa_nm


def _means(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Mean of every group of what is known."""
    known = np.isfinite(values)
    return np.array([values[known & (groups == group)].mean() for group in np.unique(groups[known])])


def _rms(values: np.ndarray) -> float:
    """RMS of what is known; NaN when nothing is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


# -- truth -------------------------------------------------------------------------------------


def _read_truths(path: Path) -> dict[str, Truth]:
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


def _read_truth(path: Path) -> Truth:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise InputDataError(f"{path}: not a readable JSON file ({error})") from error
    if not isinstance(content, dict):
        raise InputDataError(f"{path}: holds a {type(content).__name__}, not an object with mean_zernike_nm")
    try:
        return Truth.model_validate(content)
    except ValidationError as error:
        key = ".".join(map(str, error.errors()[0]["loc"]))
        raise InputDataError(f"{path}: {key}: {error.errors()[0]['msg']}") from error


def _truth_of(name: str, truths: Truths) -> Truth | None:
    """Truth of a recording: by its full name, else by what follows ``__``; None if there is none.

    Raises
    ------
    InputDataError
        When several fit.
    """
    exact = [key for key in truths if key == name]
    own = name.rpartition("__")[2]
    fitting = exact or [key for key in truths if key.rpartition("__")[2] == own]
    if len(fitting) > 1:
        raise InputDataError(
            f"recording '{name}' fits several truth files: {', '.join(fitting)}; "
            "give a folder with one of them"
        )
    return truths[fitting[0]] if fitting else None
