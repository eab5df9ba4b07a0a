"""A night of a case: written, reduced by `irlos night`, and its runs compared with the truth."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.misled.cases import RIGHT, Case
from benchmarks.misled.families import NIGHTS, RIGHT_NIGHTS, Taken
from benchmarks.misled.judging import mode_errors, ramp_errors
from benchmarks.misled.making import make_cube, make_ramp, ncpa_of
from irlos_pipe.night.reduce import Job, Reduced
from irlos_pipe.night.run import Request, run_night
from irlos_pipe.night.settings import load_settings
from irlos_pipe.night.state import Night, RunState
from irlos_pipe.product.results import read_run_results
from irlos_pipe.product.runfolder import RunFolder

BEGIN_S = 1_707_609_600  # 2024-02-11, 0 h UT
HARMED_OFFSET = 2
Truth = dict[str, dict[int, float]]  # static modes by the name of a cube
Introduced = dict[str, float]  # true defocus by the name of an offset


def night_outcome(case: Case, scratch: Path) -> dict[str, Any]:
    """Reduce the night of a `case` in a folder `scratch`; see `working.work` for the outcome.

    `sigmas` is that of the worst run that passed its quality control.
    """
    cubes, ramp = _taken(case)
    true_nm, introduced = _written(case, cubes, ramp, scratch / "archive")
    state = _reduced(scratch)
    problems = [line for night in state.nights.values() for line in (*night.failures, *night.doubts)]
    judged = [one for night in state.nights.values() for one in _judged(night, true_nm, introduced)]
    worst = max(
        (one for one in judged if one["sigmas"] is not None), key=lambda one: one["sigmas"], default={}
    )
    return {
        "accused": ["night"] if problems else [],
        "why": "; ".join(problems),
        "warned": [],
        "untested": sorted({line for one in judged for line in one["untested"]}),
        "runs": [{key: one[key] for key in ("name", "status", "sigmas")} for one in judged],
        **{key: worst.get(key) for key in ("sigmas", "error_nm", "quoted_nm")},
    }


def _taken(case: Case) -> tuple[Sequence[Taken], Taken | None]:
    if case.right:
        return RIGHT_NIGHTS[case.family.removeprefix(f"{RIGHT}: ")]
    return NIGHTS[case.family]


def _written(
    case: Case, cubes: Sequence[Taken], ramp: Taken | None, folder: Path
) -> tuple[Truth, Introduced]:
    """Write all recordings; returns the modes of every cube, and the true defocus of the ramp."""
    true_nm: Truth = {}
    for index, cube in enumerate(cubes):
        place = folder / f"cube_{index}"
        make_cube(case, cube, place, {}, 20 + index, BEGIN_S + 60 * cube.minutes)
        _harm(place, cube)
        true_nm[place.name] = ncpa_of(case, cube)
    if ramp is None:
        return true_nm, {}
    offsets, introduced = make_ramp(case, ramp, folder / "ramp", {}, BEGIN_S + 60 * ramp.minutes)
    _harm(offsets[HARMED_OFFSET], ramp)
    return true_nm, introduced


def _harm(place: Path, taken: Taken) -> None:
    path = place / f"{place.name}.fits"
    if taken.harm == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    if taken.harm == "no side-car":
        (place / "acquisition.yaml").unlink()
    if taken.harm == "copied":
        shutil.copytree(place, place.with_name(f"{place.name}_copy"))


def _reduced(scratch: Path) -> RunState:
    config = scratch / "night.yaml"
    config.write_text(
        "recipes: {calibration: [ncpa_calibration], ramp: [defocus_ramp]}\n"
        "settings:\n"
        "  ncpa_calibration: {calibrate.highest_noll: 66}\n"
        "  defocus_ramp: {calibrate.highest_noll: 66}\n"
    )
    request = Request([scratch / "archive"], scratch / "tree", load_settings(config))
    return run_night(request, lambda work, tasks: map(work, tasks))


def _judged(night: Night, true_nm: Truth, introduced: Introduced) -> list[dict[str, Any]]:
    """Return every run that has results, with its errors if it passed."""
    runs = ((job, night.reduced[job.task.name]) for job in night.jobs)
    return [_run(job, one, true_nm, introduced) for job, one in runs if not one.failed]


def _run(job: Job, one: Reduced, true_nm: Truth, introduced: Introduced) -> dict[str, Any]:
    ramp = job.group.kind == "ramp"
    last = read_run_results(RunFolder(one.folder).results).as_json()["stages"][
        "lift" if ramp else "calibrate"
    ]
    errors: dict[str, Any] = {"sigmas": None}
    if one.status == "ok" and ramp:
        errors = ramp_errors(last, introduced)
    elif one.status == "ok":
        errors = mode_errors(last["zernike_nm"], last["sigma_nm"], true_nm[job.group.first.name])
    return {"name": one.name, "status": one.status, "untested": last["untested"]} | errors
