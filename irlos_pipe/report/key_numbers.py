"""The numbers at the top of the report."""

from __future__ import annotations

import math
from collections.abc import Iterator

from irlos_pipe.report.content import KeyNumber
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_quality import quality_text
from irlos_pipe.report.sensitivity_plot import limit_text
from irlos_pipe.report.text import MISSING, number, with_error


def key_numbers(run: RunData) -> list[KeyNumber]:
    """Return what there is of the numbers to see first."""
    found = [*_calibration(run), *_ramp(run), *_limit(run), *_strehl(run), *_sky(run), *_quality(run)]
    return [one for one in found if not one.value.startswith(MISSING)]


def _calibration(run: RunData) -> Iterator[KeyNumber]:
    results = run.results("calibrate")
    sigmas = [sigma for sigma in results.get("sigma_nm", {}).values() if sigma is not None]
    nolls = sorted(int(noll) for noll in results.get("zernike_nm", {}))
    modes = f"Noll {nolls[0]}–{nolls[-1]}" if nolls else ""
    yield KeyNumber(
        "NCPAs",
        with_error(results.get("wfe_nm"), math.hypot(*sigmas), ".1f", "nm"),
        f"RMS, {modes}, {results.get('method')}",
    )
    yield KeyNumber("Calibration fit", number(results.get("chi2_nu"), ".2f"), "χ²/ν of the mean image")


def _ramp(run: RunData) -> Iterator[KeyNumber]:
    summary = run.results("lift").get("summary", {})
    line = number(summary.get("residual_rms_nm"), ".1f", "nm")
    yield KeyNumber("Ramp slope", with_error(summary.get("slope"), summary.get("slope_sigma"), ".3f"))
    yield KeyNumber("Ramp offset", number(summary.get("offset_nm"), "+.1f", "nm"))
    yield KeyNumber("Ramp error", number(summary.get("rms_nm"), ".1f", "nm RMS"), f"{line} about the line")


def _limit(run: RunData) -> Iterator[KeyNumber]:
    for curve in run.results("sensitivity").get("curves", [])[:1]:
        ncpas = "with" if curve.get("calibrated") else "without"
        limit = "not reached" if curve.get("limit_mag") is None else f"{limit_text(curve)} mag"
        yield KeyNumber("Limiting magnitude", limit, f"J, {ncpas} NCPAs, {len(curve.get('modes', []))} modes")


def _strehl(run: RunData) -> Iterator[KeyNumber]:
    results = run.results("correct")
    after = number(results.get("strehl_after"), ".3f")
    yield KeyNumber(
        "Strehl",
        f"{number(results.get('strehl_before'), '.3f')} → {after}",
        "predicted, before → after correction",
    )


def _sky(run: RunData) -> Iterator[KeyNumber]:
    results = run.results("calibrate")
    effects = results.get("effects") or {}
    halo, jitter = effects.get("seeing_halo", {}), effects.get("tip_tilt_jitter", {})
    in_band = number(halo.get("in_band_wfe_nm"), ".0f", "nm")
    yield KeyNumber(
        "Seeing", number(results.get("seeing_arcsec"), ".2f", "arcsec"), "taken for the calibration"
    )
    yield KeyNumber(
        "AO residual", number(halo.get("wfe_nm"), ".0f", "nm RMS"), f"estimated; {in_band} within the band"
    )
    yield KeyNumber("Image motion", number(jitter.get("sigma_mas"), ".1f", "mas RMS"), "estimated, per axis")


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
