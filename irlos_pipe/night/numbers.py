"""The numbers of a run that are followed from night to night."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.night.settings import Kind
from irlos_pipe.product.product import Check
from irlos_pipe.product.results import RunResults, read_run_results
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import read_product
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.diagnose.stage import DiagnoseResults
from irlos_pipe.stages.lift.stage import LiftResults


@dataclass(frozen=True)
class Measurements:
    """What a run measured."""

    status: str  # as in results.json
    # Value and standard error (None where there is none) by name; the name ends in the unit.
    numbers: dict[str, tuple[float, float | None]]
    # Verdict of `diagnose` and the effects it found; None and empty without that stage.
    verdict: str | None
    effects: list[str]
    model: str  # versions of the software and of the stages
    key: str  # key of the last product: a checksum of everything that it depends on
    checks: list[tuple[str, Check]] = field(default_factory=list)  # all QC checks with their stage

    @property
    def checks_failed(self) -> list[str]:
        return [f"{stage}: {check.name}" for stage, check in self.checks if not check.passed]


def read_measurements(folder: Path, kind: Kind) -> Measurements:
    """Read the run in a `folder` of a group of some `kind`.

    NCPAs are taken from calibration cubes and defocus from ramps, so that nothing is counted twice
    when the reduction of a ramp calibrates with the same cube again.

    Raises `InputDataError` when the run cannot be read.
    """
    run = existing_run(folder)
    products = [read_product(path, arrays=False) for path in run.products().values()]
    results = read_run_results(run.results)
    diagnosis = results.of(DiagnoseResults)
    try:
        made = [product.provenance for product in products]
        stages = [f"{one['parts']['stage']} {one['parts']['version']}" for one in made]
        model = ", ".join([f"irlos_pipe {made[-1]['software']['irlos_pipe']}", *stages])
        key = made[-1]["key"]
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
        diagnosis.verdict or None,
        [step.effect for step in diagnosis.steps],
        model,
        key,
        [(one.stage, check) for one in products for check in one.checks],
    )


def _numbers(results: RunResults, kind: Kind) -> Iterator[tuple[str, float, float]]:
    """Name, value and standard error; NaN where there is none."""
    if kind in ("calibration", "two_by_two"):
        found = results.of(CalibrateResults)
        modes = {
            noll: (value, found.sigma_nm.get(noll, math.nan)) for noll, value in found.zernike_nm.items()
        }
        if kind == "calibration":
            yield from ((f"noll_{noll}_nm", *mode) for noll, mode in modes.items())
            yield "ncpa_nm", found.higher_nm, found.higher_sigma_nm  # tip and tilt are pointing
            yield "chi2_nu", found.chi2_nu, math.nan
        else:  # the focus of the moment is no NCPA
            yield ("focus_2x2_nm", *modes.get(DEFOCUS, (math.nan, math.nan)))
        yield "seeing_arcsec", found.seeing_arcsec, math.nan
        yield "ao_residual_nm", found.effect_number("seeing_halo", "wfe_nm"), math.nan
        yield "jitter_mas", found.effect_number("tip_tilt_jitter", "sigma_mas"), math.nan
    if kind == "ramp":
        line = results.of(LiftResults).summary
        yield "defocus_bias_nm", line.offset_nm, line.offset_sigma_nm
        yield "ramp_slope", line.slope, line.slope_sigma
        yield "ramp_error_nm", line.rms_nm, math.nan
    gap = results.of(DiagnoseResults).gap
    for name in ("before", "after", "floor"):
        yield f"gap_{name}", getattr(gap, name), math.nan
