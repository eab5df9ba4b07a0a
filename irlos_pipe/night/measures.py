"""The numbers of a run that are followed from night to night."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.night.grouping import CALIBRATION, RAMP
from irlos_pipe.product.product import read_product
from irlos_pipe.product.runfolder import existing_run

Numbers = Iterator[tuple[str, Any, Any]]


@dataclass(frozen=True)
class Measured:
    """What a run tells.

    Attributes
    ----------
    numbers : dict of str to tuple of float
        Value and its 1-sigma error (None where there is none) by name; the unit ends the name.
    checks_failed : list of str
        QC checks that failed.
    verdict, effects :
        Of the stage `diagnose`; None and empty without it.
    model : str
        Versions of the software and of the stages.
    key : str
        Of the last product: a checksum of all that it depends on.
    """

    status: str
    numbers: dict[str, tuple[float, float | None]]
    checks_failed: list[str]
    verdict: str | None
    effects: list[str]
    model: str
    key: str


def read_measures(folder: Path, kind: str) -> Measured:
    """Read the run of a group of some kind.

    NCPAs are taken from calibration cubes and defocus from ramps, so that nothing is counted twice
    when the reduction of a ramp calibrates with the same cube again.

    Raises
    ------
    InputDataError
        When the run cannot be read.
    """
    run = existing_run(folder)
    made = [read_product(path, arrays=False).provenance for path in run.products().values()]
    try:
        told, quality = (json.loads(path.read_text()) for path in (run.results, run.quality))
        stages = told["stages"]
        found = {name: (value, sigma) for name, value, sigma in _numbers(stages, kind) if _is_number(value)}
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise InputDataError(f"{folder}: cannot be read ({error}); run irlos night again") from error
    diagnosis = stages.get("diagnose", {})
    return Measured(
        told["status"],
        {name: (value, sigma if _is_number(sigma) else None) for name, (value, sigma) in found.items()},
        [f"{check['stage']}: {check['name']}" for check in quality["checks"] if not check["passed"]],
        diagnosis.get("verdict"),
        [step["effect"] for step in diagnosis.get("steps", [])],
        _model(made),
        made[-1]["key"],
    )


def _numbers(stages: Mapping[str, Any], kind: str) -> Numbers:
    """Name, value, error."""
    if kind == CALIBRATION:
        yield from _calibration(stages.get("calibrate", {}))
    if kind == RAMP:
        yield from _ramp(stages.get("lift", {}))
    gap = stages.get("diagnose", {}).get("gap") or {}
    yield from ((f"gap_{name}", gap.get(name), None) for name in ("before", "after", "floor"))


def _calibration(results: Mapping[str, Any]) -> Numbers:
    sigma, effects = results.get("sigma_nm", {}), results.get("effects") or {}
    for noll, value in results.get("zernike_nm", {}).items():
        yield f"noll_{noll}_nm", value, sigma.get(noll)
    yield "ncpa_nm", results.get("wfe_nm"), results.get("wfe_sigma_nm")
    yield "seeing_arcsec", results.get("seeing_arcsec"), None
    yield "ao_residual_nm", effects.get("seeing_halo", {}).get("wfe_nm"), None
    yield "jitter_mas", effects.get("tip_tilt_jitter", {}).get("sigma_mas"), None
    yield "chi2_nu", results.get("chi2_nu"), None


def _ramp(results: Mapping[str, Any]) -> Numbers:
    summary, frames = results.get("summary", {}), len(results.get("points", []))
    scatter = summary.get("residual_rms_nm")
    sigma = scatter / math.sqrt(frames) if _is_number(scatter) and frames else None
    yield "defocus_bias_nm", summary.get("offset_nm"), sigma
    yield "ramp_slope", summary.get("slope"), summary.get("slope_sigma")
    yield "ramp_error_nm", summary.get("rms_nm"), None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _model(made: list[Mapping[str, Any]]) -> str:
    stages = [f"{one['parts']['stage']} {one['parts']['version']}" for one in made]
    return ", ".join([f"irlos_pipe {made[-1]['software']['irlos_pipe']}", *stages])
