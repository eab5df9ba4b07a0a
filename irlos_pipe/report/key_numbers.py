"""The numbers at the top of the report."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from irlos_pipe.report.content import KeyNumber
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_diagnose_verdict import verdict_numbers
from irlos_pipe.report.section_quality import quality_text
from irlos_pipe.report.section_sensitivity import curve_label, limit_text, noise_text
from irlos_pipe.report.text import MISSING, is_known, number, rounded_by_error, with_error
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.correct import CorrectResults
from irlos_pipe.stages.diagnose.results import DiagnoseResults
from irlos_pipe.stages.lift.results import LiftResults
from irlos_pipe.stages.sensitivity import SensitivityResults


def key_numbers(run: RunData) -> list[KeyNumber]:
    """Return what there is of the numbers to see first."""
    parts = (_diagnosis, _calibration, _ramp, _limit, _strehl, _sky, _quality)
    found = [one for part in parts for one in part(run)]
    return [one for one in found if not one.value.startswith(MISSING)]


def _diagnosis(run: RunData) -> Iterator[KeyNumber]:
    yield from verdict_numbers(run.results(DiagnoseResults))


def _calibration(run: RunData) -> Iterator[KeyNumber]:
    results = run.results(CalibrateResults)
    sigma_nm = math.hypot(*(sigma for sigma in results.sigma_nm.values() if math.isfinite(sigma)))
    nolls = sorted(results.zernike_nm)
    modes = f"Noll {nolls[0]}–{nolls[-1]}" if nolls else ""
    yield KeyNumber(
        "NCPAs", with_error(results.wfe_nm, sigma_nm, ".1f", "nm"), f"RMS, {modes}, {results.method}"
    )
    nominal = with_error(results.nominal_chi2_nu, results.nominal_chi2_nu_sigma, ".2f")
    expected = f"; {nominal} if nothing is missing" if nominal != MISSING else ""
    yield KeyNumber("Calibration fit", number(results.chi2_nu, ".2f"), f"χ²/ν of the mean image{expected}")


def _ramp(run: RunData) -> Iterator[KeyNumber]:
    line = run.results(LiftResults).summary
    scatter = number(line.residual_rms_nm, ".1f", "nm")
    yield KeyNumber("Ramp slope", with_error(line.slope, line.slope_sigma, ".3f"))
    yield KeyNumber("Ramp offset", number(line.offset_nm, "+.1f", "nm"))
    yield KeyNumber("Ramp error", number(line.rms_nm, ".1f", "nm RMS"), f"{scatter} about the line")


def _limit(run: RunData) -> Iterator[KeyNumber]:
    results = run.results(SensitivityResults)
    for curve in results.curves[:1]:
        limit = f"{limit_text(curve)} mag" if math.isfinite(curve.limit_mag) else "not reached"
        yield KeyNumber(
            "Limiting magnitude",
            limit,
            "; ".join(filter(None, [f"J, {curve_label(curve)}", noise_text(results.noise)])),
        )


def _strehl(run: RunData) -> Iterator[KeyNumber]:
    results = run.results(CorrectResults)
    before, after = number(results.strehl_before, ".3f"), number(results.strehl_after, ".3f")
    yield KeyNumber("Strehl", f"{before} → {after}", "predicted, before → after correction")


def _sky(run: RunData) -> Iterator[KeyNumber]:
    results = run.results(CalibrateResults)
    in_band = results.effect_number("seeing_halo", "in_band_wfe_nm")
    inside = f"estimated; {number(in_band, '.0f', 'nm')} within the band"
    yield KeyNumber("Seeing", number(results.seeing_arcsec, ".2f", "arcsec"), "taken for the calibration")
    yield KeyNumber("AO residual", _estimated(results, "seeing_halo", "wfe_nm", ".0f", "nm RMS"), inside)
    motion = _estimated(results, "tip_tilt_jitter", "sigma_mas", ".1f", "mas RMS")
    yield KeyNumber("Image motion", motion, "estimated, per axis")


def _estimated(results: CalibrateResults, effect: str, parameter: str, pattern: str, unit: str) -> str:
    """A parameter of an effect that was estimated, with its error where there is one."""
    value = results.effect_number(effect, parameter)
    sigma: Any = results.effects_sigma.get(effect, {}).get(parameter)
    if is_known(value) and isinstance(sigma, float) and is_known(sigma):
        return f"{rounded_by_error(value, sigma)} {unit}"
    return number(value, pattern, unit)


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
