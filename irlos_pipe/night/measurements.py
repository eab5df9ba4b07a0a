"""The numbers of a run that are followed from night to night."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.night.settings import Kind
from irlos_pipe.product.product import Check, Product
from irlos_pipe.product.results import RunResults, read_run_results
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import read_product
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.diagnose.results import DiagnoseResults
from irlos_pipe.stages.lift.results import LiftResults

Number = tuple[str, float, float]  # name, value, standard error; NaN where there is none


@dataclass(frozen=True)
class Measurements:
    """What a run measured.

    Attributes
    ----------
    status : str
        Status of the run, as in results.json.
    numbers : dict of str to tuple of float
        Value and standard error (None where there is none) by name; the name ends in the unit.
    checks_failed : list of str
        QC checks that failed.
    verdict, effects : str or None, list of str
        Verdict of `diagnose` and the effects it found; None and empty without that stage.
    model : str
        Versions of the software and of the stages.
    key : str
        Key of the last product: a checksum of everything that it depends on.
    checks : list of (str, Check)
        All QC checks with their stage.
    """

    status: str
    numbers: dict[str, tuple[float, float | None]]
    checks_failed: list[str]
    verdict: str | None
    effects: list[str]
    model: str
    key: str
    checks: list[tuple[str, Check]] = field(default_factory=list)


def read_measurements(folder: Path, kind: Kind) -> Measurements:
    """Read the run in a `folder` of a group of some `kind`.

    NCPAs are taken from calibration cubes and defocus from ramps, so that nothing is counted twice
    when the reduction of a ramp calibrates with the same cube again.

    Raises
    ------
    InputDataError
        When the run cannot be read.
    """
    run = existing_run(folder)
    products = [read_product(path, arrays=False) for path in run.products().values()]
    results = read_run_results(run.results)
    diagnosis = results.of(DiagnoseResults)
    try:
        model, key = _model(products), products[-1].provenance["key"]
    except (KeyError, TypeError, IndexError) as error:
        raise InputDataError(
            f"{folder}: provenance cannot be read ({error}); run irlos night again"
        ) from error
    return Measurements(
        results.status,
        {
            name: (value, sigma if math.isfinite(sigma) else None)
            for name, value, sigma in _numbers(results, kind)
            if math.isfinite(value)
        },
        [f"{one.stage}: {check.name}" for one in products for check in one.checks if not check.passed],
        diagnosis.verdict or None,
        [step.effect for step in diagnosis.steps],
        model,
        key,
        [(one.stage, check) for one in products for check in one.checks],
    )


def _numbers(results: RunResults, kind: Kind) -> Iterator[Number]:
    if kind == "calibration":
        yield from _calibration(results.of(CalibrateResults))
    if kind == "ramp":
        yield from _ramp(results.of(LiftResults))
    if kind == "two_by_two":
        yield from _two_by_two(results.of(CalibrateResults))
    gap = results.of(DiagnoseResults).gap
    yield "gap_before", gap.before, math.nan
    yield "gap_after", gap.after, math.nan
    yield "gap_floor", gap.floor, math.nan


def _calibration(results: CalibrateResults) -> Iterator[Number]:
    for noll, value_nm in results.zernike_nm.items():
        yield f"noll_{noll}_nm", value_nm, results.sigma_nm.get(noll, math.nan)
    yield "ncpa_nm", results.wfe_nm, results.wfe_sigma_nm
    yield from _of_the_sky(results)
    yield "chi2_nu", results.chi2_nu, math.nan


def _of_the_sky(results: CalibrateResults) -> Iterator[Number]:
    yield "seeing_arcsec", results.seeing_arcsec, math.nan
    yield "ao_residual_nm", results.effect_number("seeing_halo", "wfe_nm"), math.nan
    yield "jitter_mas", results.effect_number("tip_tilt_jitter", "sigma_mas"), math.nan


def _two_by_two(results: CalibrateResults) -> Iterator[Number]:
    """The focus of the moment, which is no NCPA, and what the images say of the sky."""
    yield (
        "focus_2x2_nm",
        results.zernike_nm.get(DEFOCUS, math.nan),
        results.sigma_nm.get(DEFOCUS, math.nan),
    )
    yield from _of_the_sky(results)


def _ramp(results: LiftResults) -> Iterator[Number]:
    line, frames = results.summary, len(results.points)
    yield "defocus_bias_nm", line.offset_nm, line.residual_rms_nm / math.sqrt(frames) if frames else math.nan
    yield "ramp_slope", line.slope, line.slope_sigma
    yield "ramp_error_nm", line.rms_nm, math.nan


def _model(products: Sequence[Product]) -> str:
    """Return the versions of the software and of the stages."""
    made = [product.provenance for product in products]
    stages = [f"{one['parts']['stage']} {one['parts']['version']}" for one in made]
    return ", ".join([f"irlos_pipe {made[-1]['software']['irlos_pipe']}", *stages])
