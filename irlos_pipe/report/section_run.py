"""Sections on the run: the first screen; the recordings that went in, quality control, provenance.

The first screen says whether this may be used, and if not, why; the numbers to quote, each with its meaning.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import EngFormatter

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.catalogue import CATALOGUE, effect_text
from irlos_pipe.frames.recording import PROFILE
from irlos_pipe.product.product import Check
from irlos_pipe.product.results import Provenance, meaning_of, provenance_of
from irlos_pipe.report.content import Figure, KeyNumber, Section, Table, Text, Views, shown, walked
from irlos_pipe.report.drawing import BLUE, MANY, ORANGE, figure
from irlos_pipe.report.images import MANY_DIGITS, thumbnail
from irlos_pipe.report.run_data import RunData, frame_times
from irlos_pipe.report.section_diagnose import verdict_numbers
from irlos_pipe.report.section_lift import limit_text, noise_text
from irlos_pipe.report.text import MEANING, MISSING, is_known, number, plural, rounded_by_error, with_error
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.correct import CorrectResults, checks_behind
from irlos_pipe.stages.diagnose.stage import DiagnoseResults
from irlos_pipe.stages.ingest.stage import IngestResults
from irlos_pipe.stages.lift.stage import LiftResults
from irlos_pipe.stages.sensitivity import SensitivityResults

MISFIT = "chi2 of the mean image"
# The figure to look at when a check fails; without one it is the section of its stage.
LOOK_AT = {
    MISFIT: "cal-residual", "noise as told": "cal-quantiles", "converged fits": "cal-time",
    "window": "cal-images", "motion of the star": "frames-{input}", "frames": "cal-time",
    "error of the wavefront": "cal-orders",
    "frames of one kind": "cal-time", "orientation": "cal-residual", "twin solution": "cal-ncpa",
    "predicted Strehl": "correct-budget", "slope": "ramp", "error": "ramp", "converged frames": "ramp",
    "scatter about the line": "ramp", "chi2 of the frames": "ramp-chi2",
    **dict.fromkeys(("rejected", "saturated", "missing", "centring", "flux"), "frames-{input}"),
}  # fmt: skip


# -- may it be used, and why not ---------------------------------------------------------------------


@dataclass(frozen=True)
class Reason:
    """A failed check, or a likely cause, with a link to what shows it."""

    head: str
    text: str
    link: Markup


def all_checks(run: RunData) -> list[tuple[str, Check]]:
    return [(stage, check) for stage, product in run.products.items() for check in product.checks]


def passed_text(checks: Sequence[tuple[str, Check]]) -> str:
    return f"{sum(check.passed for _, check in checks)} of {len(checks)}"


def check_value(check: Check) -> str:
    return number(check.value, ".4g", "" if check.unit == "1" else check.unit)


def answer(run: RunData) -> str:
    """Return in a sentence whether the products may be used; empty without checks."""
    checks, corrected = all_checks(run), CorrectResults.stage in run.products
    failed = sum(not check.passed for _, check in checks)
    if failed:
        use = "do not apply the correction" if corrected else "look at them before you use the results"
        if corrected and applicable(run):
            use = "none is of the correction, which may be applied"
        return f"{failed} of {len(checks)} checks failed: {use}."
    use = " The correction may be applied, if what is not tested is as declared." if corrected else ""
    return f"All {len(checks)} checks passed.{use}" if checks else ""


def failures(run: RunData, places: Mapping[str, str]) -> list[Reason]:
    """Return the failed checks; `places` are the titles of what the page has, by the names of links."""
    found, results = [], run.results(CalibrateResults)
    said = [*(one.says for one in results.causes[:1]), results.no_causes]  # below, by themselves
    for stage, check in all_checks(run):
        if check.passed:
            continue
        own = check.name.removeprefix(f"{stage}/")
        product_input = str(run.products[stage].config.get("input") or own.partition("/")[0])
        figure = LOOK_AT.get(re.split(r": |/", check.name)[-1], "").format(input=product_input)
        ends = [number(end, ".3g") for end in (check.low, check.high) if end is not None]
        limit = f" (limit{'s' if len(ends) > 1 else ''} {' to '.join(ends)})" if ends else ""
        head = f"{stage}: {own.replace('chi2', 'χ²/ν')} {check_value(check)}{limit}"
        message = min((check.message.removesuffix(f": {one}") for one in said), key=len)
        found.append(Reason(head, message, _link(places, figure, stage)))
    return found


def causes(run: RunData, places: Mapping[str, str]) -> list[Reason]:
    """Return what would explain the failed checks of a calibration, most likely first."""
    found = []
    for row in run.results(CalibrateResults).causes:
        new = is_known(row.explains) and "of the misfit" not in row.says
        known = [f"explains {number(row.explains, '.0%')} of the misfit"] if new else []
        known += [f"key {row.key}"] if row.key and row.key not in row.says else []
        found.append(Reason(row.says, "; ".join(known), _link(places, row.figure, "calibrate")))
    return found


def _link(places: Mapping[str, str], *names: str) -> Markup:
    name = next((one for one in names if one in places), "")
    return Markup('<a href="#{}">{}</a>').format(name, places[name]) if name else Markup("")


def applicable(run: RunData) -> bool:
    """Return whether all checks of the correction and what it was made from passed."""
    product = run.products.get(CorrectResults.stage)
    checks = checks_behind(run.products.values(), product.config.get("input", "")) if product else []
    return all(check.passed for check in checks)


def advice(run: RunData) -> str:
    """Return what the correction is predicted to do, or why it is not to be applied."""
    before, after = (getattr(run.results(CorrectResults), f"strehl_{when}") for when in ("before", "after"))
    if not applicable(run):
        return "Do not apply this correction: a check failed. The predictions assume that the fit is right."
    change = f"Strehl {number(before, '.3f')} → {number(after, '.3f')}"
    return f"Predicted {change}." if _gains(before, after) else f"No gain is predicted: {change}."


def _gains(before: float, after: float) -> bool:
    return not (is_known(before) and is_known(after)) or after > before


def places_of(sections: Iterable[Section]) -> dict[str, str]:
    """Return the titles of sections, figures and tables by the names that links lead to."""
    found = {}
    for section in sections:
        found[section.name] = section.title
        for block in walked(section.blocks):
            if name := getattr(block, "name", ""):
                inner = next(iter(block.choices.values())) if isinstance(block, Views) else [block]
                titles = [title for one in inner if (title := getattr(one, "title", ""))]
                found[name] = " / ".join(titles) or section.title
    return found


# -- numbers to see first ----------------------------------------------------------------------------


def key_numbers(run: RunData) -> list[KeyNumber]:
    """Return what there is of the numbers at the top of the page."""
    known = [one for one in _key_numbers(run) if not one.value.startswith(MISSING)]
    return [one if one.key == "quality" or _meaning(one.key) else replace(one, key="") for one in known]


def _key_numbers(run: RunData) -> Iterator[KeyNumber]:
    yield from verdict_numbers(run.results(DiagnoseResults))
    calibration, line = run.results(CalibrateResults), run.results(LiftResults).summary
    sensitivity, checks = run.results(SensitivityResults), all_checks(run)
    failed = {check.name for _, check in checks if not check.passed}
    for tile in _calibration(calibration):
        misfits = tile.key == "calibrate.chi2_nu" and any(name.endswith(MISFIT) for name in failed)
        yield replace(tile, mark="bad") if misfits else tile
    slope = with_error(line.slope, line.slope_sigma, ".3f")
    yield KeyNumber("Ramp slope", slope, key="lift.summary.slope")
    yield KeyNumber("Ramp offset", number(line.offset_nm, "+.1f", "nm"), key="lift.summary.offset_nm")
    note = f"{number(line.residual_rms_nm, '.1f', 'nm')} about the line"
    yield KeyNumber("Ramp error", number(line.rms_nm, ".1f", "nm RMS"), note, key="lift.summary.rms_nm")
    for curve in sensitivity.curves[:1]:
        limit = f"{limit_text(curve)} mag" if math.isfinite(curve.limit_mag) else "not reached"
        note = "; ".join(filter(None, [f"J, {curve.label}", noise_text(sensitivity.noise)]))
        yield KeyNumber("Limiting magnitude", limit, note, key="sensitivity.curves.limit_mag")
    yield from _strehl(run.results(CorrectResults), not applicable(run))
    yield from _sky(calibration)
    if checks:
        mark: Literal["good", "bad"] = "bad" if failed else "good"
        yield KeyNumber("Quality control", passed_text(checks), "checks passed", mark, "quality")


def _calibration(results: CalibrateResults) -> Iterator[KeyNumber]:
    nolls = [noll for noll in sorted(results.zernike_nm) if noll >= DEFOCUS]
    for label, modes, key in (
        ("Wavefront", nolls, "higher_nm"),
        ("Tip and tilt", sorted(set(results.zernike_nm) - set(nolls)), "tip_tilt_nm"),
    ):
        value, sigma = (
            math.hypot(*(one for noll in modes if is_known(one := values.get(noll))))
            for values in (results.zernike_nm, results.sigma_nm)
        )
        text = with_error(value or math.nan, sigma, ".1f", "nm")
        note = f"RMS, Noll {modes[0]}–{modes[-1]}, without the diversity" if modes else ""
        yield KeyNumber(label, text, note, key=f"calibrate.{key}")
    nominal = with_error(results.nominal_chi2_nu, results.nominal_chi2_nu_sigma, ".2f")
    expected = f"χ²/ν; nominal {nominal}" if nominal != MISSING else "χ²/ν of the mean image"
    yield KeyNumber("Fit", number(results.chi2_nu, ".2f"), expected, key="calibrate.chi2_nu")


def _strehl(results: CorrectResults, failed: bool) -> Iterator[KeyNumber]:
    before, after = number(results.strehl_before, ".3f"), number(results.strehl_after, ".3f")
    mark: Literal["", "bad"] = "bad" if failed else ""
    note, value = "predicted, before → after correction", f"{before} → {after}"
    if failed and MISSING not in (before, after):
        note, value = "a check failed", "do not apply"
    elif not _gains(results.strehl_before, results.strehl_after):
        note = "no gain predicted by the correction"
    yield KeyNumber("Correction" if failed else "Strehl", value, note, mark, "correct.strehl_after")
    measured, note = number(results.strehl_measured, ".3f"), "mean image, with its diversity"
    yield KeyNumber("Measured Strehl", measured, note, key="correct.strehl_measured")


def _sky(results: CalibrateResults) -> Iterator[KeyNumber]:
    """Seeing and residual of the AO system, where the model has them, and the motion of the image."""
    if "seeing_halo" in results.effects:
        seeing = number(results.seeing_arcsec, ".2f", "arcsec")
        yield KeyNumber("Seeing", seeing, "declared or assumed", key="calibrate.seeing_arcsec")
    in_band = number(results.effect_number("seeing_halo", "in_band_wfe_nm"), ".0f", "nm")
    wfe = _estimated(results, "seeing_halo", "wfe_nm", ".0f", "nm RMS")
    yield KeyNumber("AO residual", wfe, f"estimated; {in_band} within the band", key="seeing_halo")
    motion = _estimated(results, "tip_tilt_jitter", "sigma_mas", ".1f", "mas RMS")
    yield KeyNumber("Image motion", motion, "estimated, per axis", key="tip_tilt_jitter")


def _estimated(results: CalibrateResults, effect: str, parameter: str, pattern: str, unit: str) -> str:
    """A parameter of an effect that was estimated, with its error where there is one."""
    value = results.effect_number(effect, parameter)
    sigma: Any = results.effects_sigma.get(effect, {}).get(parameter)
    if is_known(value) and isinstance(sigma, float) and is_known(sigma):
        return f"{rounded_by_error(value, sigma)} {unit}"
    return number(value, pattern, unit)


# -- what they mean ----------------------------------------------------------------------------------


def meaning_section(tiles: Sequence[KeyNumber], sections: Sequence[Section]) -> Section | None:
    """Return what the numbers of `tiles` mean, and the effects that tables of the `sections` link to."""
    labels = {tile.key: tile.label for tile in tiles if _meaning(tile.key)}
    tables = (block for one in sections for block in walked(one.blocks) if isinstance(block, Table))
    cells = (cell for table in tables for row in table.rows for cell in row if isinstance(cell, Markup))
    linked = [key for cell in cells for key in re.findall(f'href="#{MEANING}([^"]*)"', cell)]
    labels |= {key: key.replace("_", " ").capitalize() for key in linked if key not in labels}
    rows = [(label, _meaning(key), key) for key, label in labels.items()]
    anchors = [f"{MEANING}{key}" for key in labels]
    table = Table(("number", "meaning", "name"), rows, prose=True, anchors=anchors)
    lead = "irlos explain NAME says more of each, and of every other number, check and figure."
    return Section("meaning", "What the numbers mean", lead, [table]) if rows else None


def _meaning(key: str) -> str:
    """The meaning of a number by its key in results.json, or of an effect by its name."""
    if kind := CATALOGUE.get(key):
        values = (f"{one.name}: {one.unit}" for one in (*kind.public, *kind.derived) if one.unit)
        return f"{effect_text(kind).partition(chr(10))[0]} Values: {'; '.join(values)}."
    stage, _, rest = key.partition(".")
    return meaning_of(STAGES[stage].Results, rest) if rest and stage in STAGES else ""


# -- what is said beside -----------------------------------------------------------------------------


def warnings(run: RunData) -> list[str]:
    """Return what the stages warned of, each once, and the exposures that failed.

    Causes of failed checks stand with these.
    """
    found = []
    for stage, product in run.products.items():
        found += [
            f"{stage}: {line.partition(' ')[2]}"
            for line in product.log
            if line.startswith(("WARNING ", "ERROR ", "CRITICAL ")) and " Cause " not in line[:15]
        ]
        found += [f"{stage}: lost: {failure}" for failure in provenance_of(product).failures]
    return list(dict.fromkeys(found))


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
    table = Table.of(
        rows,
        {
            "mean frame": lambda row: pictures.get((row.input, row.name), ""),
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
    instrument, stated = run.outcome.instrument, all("instrument" in row.sources for row in rows)
    if instrument:
        lead += f" Instrument {instrument}{'' if stated else ', which no side-car states'}."
    profile = f"profile {instrument}".strip()
    owners = dict.fromkeys(one.input for one in run.recordings)
    blocks = shown(
        [_frames(run, owner) for owner in owners],
        Table(("recording", "frames", "reason"), reasons, "Rejected frames"),
        Text(f"Not in the data, taken from the instrument {profile}: {listed}.") if listed else None,
    )
    return Section("ingest", "Recordings", lead, [table, *blocks])


def _frames(run: RunData, owner: str) -> Figure | None:
    """Light, width, place of the star and level of every used frame of a recipe input against time."""
    recordings = [one for one in run.recordings if one.input == owner and one.series]
    if sum(one.used.sum() for one in recordings) < 2:
        return None
    seconds, scales = frame_times(recordings)[0], [one.acquisition.pixel_scale_mas for one in recordings]
    image = run.of(CorrectResults).arrays.get("perfect")
    known = image is not None and image.value.shape == recordings[0].mean_e.shape
    perfect = float(image.value.max() / image.value.sum()) if image is not None and known else None

    def series(name: str, in_mas: bool = False) -> np.ndarray:
        values = (one.series[name][one.used] for one in recordings)
        return np.concatenate(
            [one * (scale or np.nan if in_mas else 1.0) for one, scale in zip(values, scales, strict=True)]
        )

    rows = {
        "flux [e⁻]": [series("flux_e")],
        "FWHM [mas]": [series("fwhm_px", True)],
        "Strehl ratio" if perfect else "peak / flux": [
            series("peak_e") / series("flux_e") / (perfect or 1.0)
        ],
        "centroid x (blue), y (orange) [mas]": [series(f"{axis}_px", True) for axis in "xy"],
        "level [e⁻/px]": [series("level_e")],
    }

    def draw(canvas: Canvas) -> None:
        stack = canvas.subplots(len(rows), sharex=True)
        for axes, (title, curves) in zip(stack, rows.items(), strict=True):
            for values, colour in zip(curves, (BLUE, ORANGE), strict=False):
                axes.plot(seconds, values, ".", color=colour, markersize=2, rasterized=len(values) > MANY)
            axes.set_title(title, loc="left", pad=2)
            axes.locator_params(axis="y", nbins=4)
            if np.nanmax(np.abs(curves[0]), initial=0.0) >= MANY_DIGITS:
                axes.yaxis.set_major_formatter(EngFormatter(sep=""))
        stack[-1].set_xlabel("time [s]")

    caption = "Used frames, each by itself, diversity and introduced defocus included" + (
        "; Strehl: brightest pixel over the sum of the window, divided by that of the perfect image."
        if perfect
        else "."
    )
    return figure(f"frames-{owner}", (6.0, 5.2), draw, f"Frames of {owner}", caption)


# -- quality control ---------------------------------------------------------------------------


def quality_section(run: RunData) -> Section | None:
    """Build the section on checks: failed ones first, then those of each stage; None without any check."""
    checks = all_checks(run)
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
    return Section("quality", "Quality control", f"{passed_text(checks)} checks passed", tables)


def _check_table(title: str, checks: list[tuple[str, Check]], folded: bool = False) -> Table:
    rows = []
    for stage, check in checks:
        name, state = check.name.removeprefix(f"{stage}/"), "passed" if check.passed else "FAILED"
        rows.append((state, stage, name, check_value(check), check.limits, check.message))
    marks = ["good" if check.passed else "bad" for _, check in checks]
    columns = ("result", "stage", "check", "value", "limits", "message")
    return Table(columns, rows, title, marks=marks, folded=folded, prose=True)


# -- provenance --------------------------------------------------------------------------------


def origin_section(run: RunData) -> Section:
    """Build the section on where the products come from, and the recipe."""
    last = _latest(run)
    facts = [f"instrument {run.outcome.instrument}"] if run.outcome.instrument else []
    facts += [last.command, f"seed {'' if last.seed is None else last.seed}"]
    facts += [f"{last.machine.host} ({last.machine.platform})"]
    facts += [f"{name} {version}" for name, version in last.software.items()]
    stages = Table.of(
        [(stage, provenance_of(product)) for stage, product in run.products.items()],
        {
            "stage": lambda one: one[0],
            "files": lambda one: Markup(", ").join(
                Markup('<a href="{0}">{0}</a>').format(name)
                for name in filter(None, (run.files.get(one[0]), *one[1].files))
            ),
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


def _latest(run: RunData) -> Provenance:
    """Provenance of the product made last."""
    made = (provenance_of(product) for product in run.products.values())
    return max(made, key=lambda one: one.finished, default=Provenance())


def _moment(iso_time: str) -> str:
    return f"{iso_time[:16].replace('T', ' ')} UTC" if iso_time else ""
