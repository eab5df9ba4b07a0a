"""One case from beginning to end: make it, reduce it as a user does, compare with the truth."""

from __future__ import annotations

import logging
import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Outcome, reduced
from benchmarks.misled.cases import (
    CALIBRATION,
    DIAGNOSIS,
    NIGHT,
    NIGHTS,
    RAMP,
    RIGHT,
    RIGHT_NIGHTS,
    Case,
    Taken,
)
from benchmarks.misled.making import Made, make_case, make_cube, make_ramp, ncpa_of
from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.night.reduce import Job, Reduced
from irlos_pipe.night.run import Request, run_night
from irlos_pipe.night.settings import load_settings
from irlos_pipe.product.results import read_run_results
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.recipe import load_recipe

# Recipe, its inputs, settings, and the stage whose numbers count. Noll 66 ends the modes: the open basis
# costs five times as long and has the same low modes.
RECIPES: dict[str, tuple[str, tuple[str, ...], tuple[str, ...], str]] = {
    CALIBRATION: ("ncpa_calibration", ("calibration",), ("calibrate.highest_noll=66",), "calibrate"),
    RAMP: ("defocus_ramp", ("ramp", "calibration"), ("calibrate.highest_noll=66",), "lift"),
    DIAGNOSIS: ("diagnose", ("cube",), (), "diagnose"),
}
NIGHT_SETTINGS = """recipes: {calibration: [ncpa_calibration], ramp: [defocus_ramp]}
settings:
  ncpa_calibration: {calibrate.highest_noll: 66}
  defocus_ramp: {calibrate.highest_noll: 66}
"""
BEGIN_S = 1_707_609_600  # 2024-02-11, 0 h UT
HARMED_OFFSET = 2
ERROR = "refused"
IN_THE_PUPIL = {"low_wind_effect", "phase_bump"}  # part of the wavefront: the modes hold a part of them
Numbers = dict[str, Any]


class Collected(logging.Handler):
    """Keeps warnings as text."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        self.lines.append(record.getMessage())


def outcome_of(case: Case, *_) -> Outcome:
    """Make, reduce and judge a case."""
    began = time.process_time()
    fields = ("kind", "family", "setting", "right", "cause", "suite_seed")
    outcome = {"case": case.name} | {name: getattr(case, name) for name in fields}
    warned = Collected()
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = (_night if case.kind == NIGHT else _recordings)(case, Path(folder), warned)
        except IrlosError as problem:
            found = {"accused": [ERROR], "why": str(problem), "warned": warned.lines, "sigmas": None}
    return outcome | found | {"cpu_s": round(time.process_time() - began, 2)}


def _recordings(case: Case, scratch: Path, warned: Collected) -> Numbers:
    """Reduce recordings by the stages of their recipe one after the other, without files and report."""
    recipe_name, declared, settings, last = RECIPES[case.kind]
    made = make_case(case, scratch)
    recipe = load_recipe(
        recipe_name, settings, [f"{name}={path}" for name in declared for path in made.inputs[name]]
    )
    log = logging.Logger("misled")
    log.addHandler(warned)
    products, failed = reduced(recipe, scratch, log)
    results = products[last].results
    return {
        "accused": [check.name for check in failed],
        "why": "; ".join(check.message for check in failed),
        "warned": warned.lines,
        "untested": results.get("untested", []),
        **_errors(case, made, results),
    }


# -- against the truth -------------------------------------------------------------------------


def _errors(case: Case, made: Made, results: Outcome) -> Numbers:
    """True errors over the quoted ones, and of a diagnosis what it found."""
    if case.kind == DIAGNOSIS:
        return diagnosis_errors(case, results, made.ncpa_nm)
    if case.kind == RAMP:
        return ramp_errors(results, made.introduced_nm)
    return mode_errors(results["zernike_nm"], results["sigma_nm"], made.ncpa_nm)


def ramp_errors(results: Outcome, introduced_nm: Mapping[str, float]) -> Numbers:
    """Return the RMS over the frames of the true errors over the quoted ones, from the section `lift`."""
    points = results["points"]
    error = _numbers(point["defocus_nm"] for point in points)
    error = error - [introduced_nm[point["name"]] for point in points]
    sigma = _numbers(point["sigma_nm"] for point in points)
    chi2_ratio = (results["chi2_nu"] or np.nan) / (results["nominal_chi2_nu"] or np.nan)
    return {
        "sigmas": _rms(error / sigma),
        "error_nm": _rms(error),
        "quoted_nm": _rms(sigma),
        "slope": results["summary"]["slope"],
        "chi2_ratio": float(chi2_ratio),
    }


def mode_errors(modes_nm: Outcome, sigma_nm: Outcome, true_nm: Mapping[int, float]) -> Numbers:
    """Return the true error over the quoted one of the worst mode from Noll 4 on."""
    nolls = [noll for noll in modes_nm if int(noll) > 3]
    error = _numbers(modes_nm[noll] for noll in nolls) - [true_nm.get(int(noll), 0.0) for noll in nolls]
    sigma = _numbers(sigma_nm[noll] for noll in nolls)
    worst = float(np.max(np.abs(error / sigma)))
    return {"sigmas": worst, "error_nm": _total(error), "quoted_nm": _total(sigma)}


def diagnosis_errors(case: Case, results: Outcome, true_nm: Mapping[int, float]) -> Numbers:
    """Return what the section `diagnose` says of what is hidden, and the error of its modes.

    ``finding`` is ``none``, ``named`` (rightly), ``misnamed``, ``unknown``, or ``too small``: not found, and
    below what the diagnosis states that it can detect.
    """
    modes = mode_errors(results["zernike_nm"]["after"], results["sigma_nm"], true_nm)
    if IN_THE_PUPIL & set(case.taken.hidden):
        modes["sigmas"] = None
    named = {name for step in results["steps"] for name in (step["effect"], *step["indistinguishable"])}
    return modes | {
        "finding": _finding(case, results, named),
        "named": sorted(named),
        "grade": results["grade"],
        "mdb": {name: results["mdb"].get(name) for name in case.names},
    }


def _finding(case: Case, results: Outcome, named: set[str]) -> str:
    if results["verdict"] == "effect":
        return "named" if named & set(case.names) else "misnamed"
    hidden = case.taken.hidden
    if results["verdict"] == "none" and hidden and all(_below(*one, results) for one in hidden.items()):
        return "too small"
    return str(results["verdict"])


def _below(name: str, parameters: Mapping[str, Any], results: Outcome) -> bool:
    """Whether all sizes of a hidden effect are below the smallest detectable ones, or cannot be tested."""
    stated = {key: np.ravel(value) for key, value in (results["mdb"].get(name) or {}).items()}
    common = [key for key in stated if key in parameters]
    if not common:
        return name in results["untestable"]
    sizes = (float(np.max(np.abs(parameters[key]))) for key in common)
    limits = (float(np.max(np.abs(_numbers(stated[key])))) for key in common)
    return all(size < limit for size, limit in zip(sizes, limits, strict=True))


def _numbers(values: Any) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], float)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _total(values: np.ndarray) -> float:
    return float(np.sqrt(np.nansum(values**2)))


# -- nights ------------------------------------------------------------------------------------


def _night(case: Case, scratch: Path, *_) -> Numbers:
    """Write a night and reduce it by `irlos night`; `sigmas` is that of the worst run that passed."""
    true_nm, introduced_nm = write_night(case, scratch / "archive")
    config = scratch / "night.yaml"
    config.write_text(NIGHT_SETTINGS)
    request = Request([scratch / "archive"], scratch / "tree", load_settings(config))
    state = run_night(request, lambda work, tasks: map(work, tasks))
    problems = [line for night in state.nights.values() for line in (*night.failures, *night.doubts)]
    runs = [(job, night.reduced[job.task.name]) for night in state.nights.values() for job in night.jobs]
    judged = [_run(job, one, true_nm, introduced_nm) for job, one in runs if not one.failed]
    passed = [one for one in judged if one["sigmas"] is not None]
    worst = max(passed, key=lambda one: one["sigmas"], default={})
    return {
        "accused": ["night"] if problems else [],
        "why": "; ".join(problems),
        "warned": [],
        "untested": sorted({line for one in judged for line in one["untested"]}),
        "runs": [{key: one[key] for key in ("name", "status", "sigmas")} for one in judged],
        **{key: worst.get(key) for key in ("sigmas", "error_nm", "quoted_nm")},
    }


def write_night(case: Case, folder: Path) -> tuple[dict[str, dict[int, float]], dict[str, float]]:
    """Write all recordings; returns the modes of every cube, and the true defocus of the ramp, by name."""
    cubes, ramp = (NIGHTS | RIGHT_NIGHTS)[case.family.removeprefix(f"{RIGHT}: ")]
    true_nm = {}
    for index, cube in enumerate(cubes):
        place = folder / f"cube_{index}"
        make_cube(case, cube, place, {}, 20 + index, BEGIN_S + 60 * cube.minutes)
        _harm(place, cube)
        true_nm[place.name] = ncpa_of(case, cube)
    if ramp is None:
        return true_nm, {}
    offsets, introduced_nm = make_ramp(case, ramp, folder / "ramp", {}, BEGIN_S + 60 * ramp.minutes)
    _harm(offsets[HARMED_OFFSET], ramp)
    return true_nm, introduced_nm


def _harm(place: Path, taken: Taken) -> None:
    path = place / f"{place.name}.fits"
    if taken.harm == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    if taken.harm == "no side-car":
        (place / "acquisition.yaml").unlink()
    if taken.harm == "copied":
        shutil.copytree(place, place.with_name(f"{place.name}_copy"))


def _run(
    job: Job, one: Reduced, true_nm: Mapping[str, Mapping[int, float]], introduced_nm: Mapping[str, float]
) -> Numbers:
    """Return a run that has results, with its errors if it passed."""
    ramp = job.group.kind == "ramp"
    stages = read_run_results(RunFolder(one.folder).results).as_json()["stages"]
    last = stages["lift" if ramp else "calibrate"]
    errors: Numbers = {"sigmas": None}
    if one.status == "ok" and ramp:
        errors = ramp_errors(last, introduced_nm)
    elif one.status == "ok":
        errors = mode_errors(last["zernike_nm"], last["sigma_nm"], true_nm[job.group.first.name])
    return {"name": one.name, "status": one.status, "untested": last["untested"]} | errors
