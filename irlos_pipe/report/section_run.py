"""Sections on the run: the recordings that went in, quality control, provenance; numbers to see first."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from markupsafe import Markup

from irlos_pipe.frames.recording import PROFILE
from irlos_pipe.product.product import Check
from irlos_pipe.product.results import Provenance, provenance_of
from irlos_pipe.report.content import KeyNumber, Section, Table, Text, shown
from irlos_pipe.report.images import thumbnail
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_diagnose import verdict_numbers
from irlos_pipe.report.section_sensitivity import curve_label, limit_text, noise_text
from irlos_pipe.report.text import MISSING, is_known, number, plural, rounded_by_error, with_error
from irlos_pipe.stages.calibrate.results import CalibrateResults
from irlos_pipe.stages.correct import CorrectResults
from irlos_pipe.stages.diagnose.results import DiagnoseResults
from irlos_pipe.stages.ingest.results import IngestResults, RecordingRow
from irlos_pipe.stages.lift.results import LiftResults
from irlos_pipe.stages.sensitivity import SensitivityResults

MOST_THUMBNAILS = 60  # images of recordings that are shown
CHECKSUM_DIGITS = 12  # of a checksum that are shown
# A stage with more passed checks than this shows them when asked.
FOLDED_ABOVE = 10

# -- recordings --------------------------------------------------------------------------------


def ingest_section(run: RunData) -> Section:
    rows = run.results(IngestResults).inputs
    pictures = {
        (one.input, one.name): thumbnail(np.where(one.good, one.mean_e, np.nan), one.name)
        for one in run.recordings[:MOST_THUMBNAILS]
    }

    def picture(row: RecordingRow) -> str | Markup:
        return pictures.get((row.input, row.name), "")

    table = Table.of(
        rows,
        {
            "mean frame": picture,
            "recording": lambda row: row.name,
            "input": lambda row: row.input,
            "role": lambda row: row.role,
            "frames": lambda row: number(row.frames, "d"),
            "rejected": lambda row: number(row.frames_rejected, "d"),
            "missing": lambda row: number(row.frames_missing, "d"),
            "window [px]": lambda row: "×".join(map(str, row.window)),
            "flux [e⁻/frame]": lambda row: number(row.flux_e, ".3g"),
            "J [mag]": lambda row: number(row.mag_j, "g"),
            "bad pixels": lambda row: str(len(row.bad_pixels)),
            "cosmics": lambda row: number(row.cosmic_hits, "d"),
        },
    )
    reasons = [(row.name, str(count), reason) for row in rows for reason, count in row.reasons.items()]
    assumed = Counter(key for row in rows for key, source in row.sources.items() if source == PROFILE)
    listed = ", ".join(f"{key} ({plural(count, 'recording')})" for key, count in sorted(assumed.items()))
    lead = f"{plural(len(rows), 'recording')}, {plural(sum(row.frames for row in rows), 'frame')}."
    stated = all("instrument" in row.sources for row in rows)
    lead += f" Instrument {run.instrument}{'' if stated else ', which no side-car states'}." * bool(
        run.instrument
    )
    blocks = shown(
        Table(("recording", "frames", "reason"), reasons, "Rejected frames"),
        Text(f"Not in the data, taken from the instrument profile: {listed}.") if listed else None,
    )
    return Section("ingest", "Recordings", lead, [table, *blocks])


# -- quality control ---------------------------------------------------------------------------


def quality_section(run: RunData) -> Section | None:
    """Build the section on checks: failed ones first, then those of each stage; None without any check."""
    checks = _checks(run)
    if not checks:
        return None
    passed = {stage: [one for one in checks if one[0] == stage and one[1].passed] for stage in run.products}
    few = [one for found in passed.values() if len(found) <= FOLDED_ABOVE for one in found]
    many = {stage: found for stage, found in passed.items() if len(found) > FOLDED_ABOVE}
    tables = shown(
        _check_table("Failed", [one for one in checks if not one[1].passed]),
        _check_table("Passed", few),
        [_check_table(f"{stage}: {len(found)} passed", found, folded=True) for stage, found in many.items()],
    )
    return Section("quality", "Quality control", f"{_passed(checks)} checks passed", tables)


def _checks(run: RunData) -> list[tuple[str, Check]]:
    return [(stage, check) for stage, product in run.products.items() for check in product.checks]


def _passed(checks: list[tuple[str, Check]]) -> str:
    return f"{sum(check.passed for _, check in checks)} of {len(checks)}"


def _check_table(title: str, checks: list[tuple[str, Check]], folded: bool = False) -> Table:
    rows = []
    for stage, check in checks:
        value = number(check.value, ".4g", "" if check.unit == "1" else check.unit)
        name = check.name.removeprefix(f"{stage}/")
        rows.append(("passed" if check.passed else "FAILED", stage, name, value, check.limits, check.message))
    marks = ["good" if check.passed else "bad" for _, check in checks]
    columns = ("", "stage", "check", "value", "limits", "message")
    return Table(columns, rows, title, marks=marks, folded=folded, prose=True)


# -- provenance --------------------------------------------------------------------------------


def origin_section(run: RunData) -> Section:
    """Build the section on where the products come from, and the recipe."""
    last = _latest(run)
    facts = [f"instrument {run.instrument}"] if run.instrument else []
    facts += [last.command, f"seed {'' if last.seed is None else last.seed}"]
    facts += [f"{last.machine.host} ({last.machine.platform})"]
    facts += [f"{name} {version}" for name, version in last.software.items()]
    stages = Table.of(
        [(stage, provenance_of(product)) for stage, product in run.products.items()],
        {
            "stage": lambda one: one[0],
            "finished": lambda one: _moment(one[1].finished),
            "time [s]": lambda one: number(one[1].seconds),
            "device": lambda one: one[1].device,
            "threads": lambda one: "" if one[1].jobs is None else str(one[1].jobs),
            "irlos_pipe": lambda one: one[1].software.get("irlos_pipe", ""),
        },
        "Stages",
    )
    inputs = [(one.label, one.sha256[:CHECKSUM_DIGITS]) for one in last.inputs]
    files = Table(("file", "sha256"), inputs, f"Input files ({len(inputs)})", folded=True)
    recipe = Text(run.recipe_text, "Resolved recipe", verbatim=True, folded=True)
    return Section("origin", "Provenance", " · ".join(facts), [stages, *shown(files, recipe)])


def finished(run: RunData) -> str:
    """Return when the last stage ended, to the minute; empty without products."""
    return _moment(_latest(run).finished)


def warnings(run: RunData) -> list[str]:
    """Return what the stages warned of, each once, and the exposures that failed."""
    found = []
    for stage, product in run.products.items():
        found += [
            f"{stage}: {line.partition(' ')[2]}"
            for line in product.log
            if line.startswith(("WARNING ", "ERROR ", "CRITICAL "))
        ]
        found += [f"{stage}: lost: {failure}" for failure in provenance_of(product).failures]
    return list(dict.fromkeys(found))


def _latest(run: RunData) -> Provenance:
    """Provenance of the product made last."""
    made = (provenance_of(product) for product in run.products.values())
    return max(made, key=lambda one: one.finished, default=Provenance())


def _moment(iso_time: str) -> str:
    return f"{iso_time[:16].replace('T', ' ')} UTC" if iso_time else ""


# -- numbers to see first ----------------------------------------------------------------------


def key_numbers(run: RunData) -> list[KeyNumber]:
    """Return what there is of the numbers at the top of the page."""
    return [one for one in _key_numbers(run) if not one.value.startswith(MISSING)]


def _key_numbers(run: RunData) -> Iterator[KeyNumber]:
    yield from verdict_numbers(run.results(DiagnoseResults))
    calibration, line = run.results(CalibrateResults), run.results(LiftResults).summary
    sensitivity, correct = run.results(SensitivityResults), run.results(CorrectResults)
    yield from _calibration(calibration)
    yield KeyNumber("Ramp slope", with_error(line.slope, line.slope_sigma, ".3f"))
    yield KeyNumber("Ramp offset", number(line.offset_nm, "+.1f", "nm"))
    scatter = number(line.residual_rms_nm, ".1f", "nm")
    yield KeyNumber("Ramp error", number(line.rms_nm, ".1f", "nm RMS"), f"{scatter} about the line")
    for curve in sensitivity.curves[:1]:
        limit = f"{limit_text(curve)} mag" if math.isfinite(curve.limit_mag) else "not reached"
        note = "; ".join(filter(None, [f"J, {curve_label(curve)}", noise_text(sensitivity.noise)]))
        yield KeyNumber("Limiting magnitude", limit, note)
    before, after = number(correct.strehl_before, ".3f"), number(correct.strehl_after, ".3f")
    yield KeyNumber("Strehl", f"{before} → {after}", "predicted, before → after correction")
    yield from _sky(calibration)
    checks = _checks(run)
    if checks:
        passed = all(check.passed for _, check in checks)
        mark: Literal["good", "bad"] = "good" if passed else "bad"
        yield KeyNumber("Quality control", _passed(checks), "checks passed", mark)


def _calibration(results: CalibrateResults) -> Iterator[KeyNumber]:
    sigma_nm = math.hypot(*(sigma for sigma in results.sigma_nm.values() if math.isfinite(sigma)))
    nolls = sorted(results.zernike_nm)
    modes = f"Noll {nolls[0]}–{nolls[-1]}" if nolls else ""
    wfe = with_error(results.wfe_nm, sigma_nm, ".1f", "nm")
    yield KeyNumber("NCPAs", wfe, f"RMS, {modes}, {results.method}")
    nominal = with_error(results.nominal_chi2_nu, results.nominal_chi2_nu_sigma, ".2f")
    expected = f"; {nominal} if nothing is missing" if nominal != MISSING else ""
    yield KeyNumber("Calibration fit", number(results.chi2_nu, ".2f"), f"χ²/ν of the mean image{expected}")


def _sky(results: CalibrateResults) -> Iterator[KeyNumber]:
    in_band = number(results.effect_number("seeing_halo", "in_band_wfe_nm"), ".0f", "nm")
    yield KeyNumber("Seeing", number(results.seeing_arcsec, ".2f", "arcsec"), "taken for the calibration")
    wfe = _estimated(results, "seeing_halo", "wfe_nm", ".0f", "nm RMS")
    yield KeyNumber("AO residual", wfe, f"estimated; {in_band} within the band")
    motion = _estimated(results, "tip_tilt_jitter", "sigma_mas", ".1f", "mas RMS")
    yield KeyNumber("Image motion", motion, "estimated, per axis")


def _estimated(results: CalibrateResults, effect: str, parameter: str, pattern: str, unit: str) -> str:
    """A parameter of an effect that was estimated, with its error where there is one."""
    value = results.effect_number(effect, parameter)
    sigma: Any = results.effects_sigma.get(effect, {}).get(parameter)
    if is_known(value) and isinstance(sigma, float) and is_known(sigma):
        return f"{rounded_by_error(value, sigma)} {unit}"
    return number(value, pattern, unit)
