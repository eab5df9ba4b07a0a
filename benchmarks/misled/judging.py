"""Results against the truth: how many quoted errors they are off, and what a diagnosis named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.misled.cases import Case

IN_THE_PUPIL = {"low_wind_effect", "phase_bump"}  # part of the wavefront: the modes hold a part of them
Results = Mapping[str, Any]
Numbers = dict[str, Any]


def ramp_errors(results: Results, introduced_nm: Mapping[str, float]) -> Numbers:
    """Return the RMS over the frames of the true errors over the quoted ones, from the section `lift`."""
    points = results["points"]
    error = _numbers(point["defocus_nm"] for point in points)
    error = error - [introduced_nm[point["name"]] for point in points]
    sigma = _numbers(point["sigma_nm"] for point in points)
    sigmas = float(np.sqrt(np.nanmean((error / sigma) ** 2)))
    chi2_ratio = (results["chi2_nu"] or np.nan) / (results["nominal_chi2_nu"] or np.nan)
    return {
        "sigmas": sigmas,
        "error_nm": _rms(error),
        "quoted_nm": _rms(sigma),
        "slope": results["summary"]["slope"],
        "chi2_ratio": float(chi2_ratio),
    }


def mode_errors(modes_nm: Results, sigma_nm: Results, true_nm: Mapping[int, float]) -> Numbers:
    """Return the true error over the quoted one of the worst mode from Noll 4 on."""
    nolls = [noll for noll in modes_nm if int(noll) > 3]
    error = _numbers(modes_nm[noll] for noll in nolls) - [true_nm.get(int(noll), 0.0) for noll in nolls]
    sigma = _numbers(sigma_nm[noll] for noll in nolls)
    worst = float(np.max(np.abs(error / sigma)))
    return {"sigmas": worst, "error_nm": _total(error), "quoted_nm": _total(sigma)}


def diagnosis_errors(case: Case, results: Results, true_nm: Mapping[int, float]) -> Numbers:
    """Return what the section `diagnose` says of what is hidden, and the error of its modes.

    ``finding`` is ``none``, ``named`` (rightly), ``misnamed``, ``unknown``, or ``too small``: not found, and
    below what the diagnosis states that it can detect.
    """
    modes = mode_errors(results["zernike_nm"]["after"], results["sigma_nm"], true_nm)
    if IN_THE_PUPIL & set(case.hidden):
        modes["sigmas"] = None
    named = {name for step in results["steps"] for name in (step["effect"], *step["indistinguishable"])}
    return modes | {
        "finding": _finding(case, results, named),
        "named": sorted(named),
        "grade": results["grade"],
        "mdb": {name: results["mdb"].get(name) for name in case.names},
    }


def _finding(case: Case, results: Results, named: set[str]) -> str:
    if results["verdict"] == "effect":
        return "named" if named & set(case.names) else "misnamed"
    if results["verdict"] == "none" and case.hidden and all(map(_below, *_sizes(case, results))):
        return "too small"
    return str(results["verdict"])


def _sizes(case: Case, results: Results) -> tuple[list[float], list[float]]:
    """Sizes of the hidden effects, and the smallest detectable ones; infinite where it cannot be tested."""
    sizes, limits = [], []
    for name, parameters in case.hidden.items():
        smallest = results["mdb"].get(name) or {}
        absolute = {key: float(np.max(np.abs(value))) for key, value in parameters.items()}
        stated = {key: float(np.max(np.abs(_numbers(np.ravel(value))))) for key, value in smallest.items()}
        common = [key for key in stated if key in absolute]
        sizes += [absolute[key] for key in common] or [0.0]
        limits += [stated[key] for key in common] or [np.inf if name in results["untestable"] else 0.0]
    return sizes, limits


def _below(size: float, limit: float) -> bool:
    return size < limit


def _numbers(values: Any) -> np.ndarray:
    return np.array([np.nan if value is None else value for value in values], float)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _total(values: np.ndarray) -> float:
    return float(np.sqrt(np.nansum(values**2)))
