"""The numbers at the top of the report."""

from __future__ import annotations

import math
from collections.abc import Iterator

from irlos_pipe.report.content import KeyNumber
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_quality import quality_text
from irlos_pipe.report.section_sensitivity import curve_label, limit_text
from irlos_pipe.report.text import MISSING, number, with_error
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.correct.results import CorrectResults
from irlos_pipe.stages.diagnose.results import DiagnoseResults
from irlos_pipe.stages.lift.results import LiftResults
from irlos_pipe.stages.sensitivity.results import SensitivityResults


def key_numbers(run: RunData) -> list[KeyNumber]:
    """Return what there is of the numbers to see first."""
    parts = (_diagnosis, _calibration, _ramp, _limit, _strehl, _sky, _quality)
    found = [one for part in parts for one in part(run)]
    return [one for one in found if not one.value.startswith(MISSING)]


def _diagnosis(run: RunData) -> Iterator[KeyNumber]:
    results = run.results(DiagnoseResults)
    gap = results.gap
    if results.grade:
        numbers = [number(value, ".3f") for value in (gap.before, gap.after, gap.floor)]
        yield KeyNumber(
            "Diagnosis",
            f"{results.verdict}, {results.grade}",
            "gap {} → {}, noise alone {}".format(*numbers),
            "good" if results.grade in ("none", "complete") and not results.unexplained else "bad",
        )


def _calibration(run: RunData) -> Iterator[KeyNumber]:
    results = run.results(CalibrateResults)
    sigma_nm = math.hypot(*(sigma for sigma in results.sigma_nm.values() if math.isfinite(sigma)))
    nolls = sorted(results.zernike_nm)
    modes = f"Noll {nolls[0]}–{nolls[-1]}" if nolls else ""
    yield KeyNumber(
        "NCPAs", with_error(results.wfe_nm, sigma_nm, ".1f", "nm"), f"RMS, {modes}, {results.method}"
    )
    yield KeyNumber("Calibration fit", number(results.chi2_nu, ".2f"), "χ²/ν of the mean image")


def _ramp(run: RunData) -> Iterator[KeyNumber]:
    line = run.results(LiftResults).summary
    scatter = number(line.residual_rms_nm, ".1f", "nm")
    yield KeyNumber("Ramp slope", with_error(line.slope, line.slope_sigma, ".3f"))
    yield KeyNumber("Ramp offset", number(line.offset_nm, "+.1f", "nm"))
    yield KeyNumber("Ramp error", number(line.rms_nm, ".1f", "nm RMS"), f"{scatter} about the line")


def _limit(run: RunData) -> Iterator[KeyNumber]:
    for curve in run.results(SensitivityResults).curves[:1]:
        limit = f"{limit_text(curve)} mag" if math.isfinite(curve.limit_mag) else "not reached"
        yield KeyNumber("Limiting magnitude", limit, f"J, {curve_label(curve)}")


def _strehl(run: RunData) -> Iterator[KeyNumber]:
    results = run.results(CorrectResults)
    before, after = number(results.strehl_before, ".3f"), number(results.strehl_after, ".3f")
    yield KeyNumber("Strehl", f"{before} → {after}", "predicted, before → after correction")


def _sky(run: RunData) -> Iterator[KeyNumber]:
    results = run.results(CalibrateResults)
    total, in_band = (results.effect_number("seeing_halo", key) for key in ("wfe_nm", "in_band_wfe_nm"))
    inside = f"estimated; {number(in_band, '.0f', 'nm')} within the band"
    jitter_mas = results.effect_number("tip_tilt_jitter", "sigma_mas")
    yield KeyNumber("Seeing", number(results.seeing_arcsec, ".2f", "arcsec"), "taken for the calibration")
    yield KeyNumber("AO residual", number(total, ".0f", "nm RMS"), inside)
    yield KeyNumber("Image motion", number(jitter_mas, ".1f", "mas RMS"), "estimated, per axis")


def _quality(run: RunData) -> Iterator[KeyNumber]:
    checks = [check for product in run.products.values() for check in product.checks]
    if checks:
        passed = all(check.passed for check in checks)
        yield KeyNumber(
            "Quality control",
            quality_text(run).removesuffix(" checks passed"),
            "checks passed",
            "good" if passed else "bad",
        )
