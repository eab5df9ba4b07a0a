"""The sections and key numbers of a night's page."""

from __future__ import annotations

from collections.abc import Iterator

from markupsafe import Markup

from irlos_pipe.night.database import Verdict
from irlos_pipe.night.description import Description, utc_time
from irlos_pipe.night.reduce import UNCHANGED, Reduced
from irlos_pipe.night.state import Night
from irlos_pipe.night.tasks import Job
from irlos_pipe.night.trend import Series, Trend
from irlos_pipe.night.trend_text import label, validity_number, validity_text
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.report.content import Figure, KeyNumber, Section, Stack, Table, Text
from irlos_pipe.report.text import MISSING, duration, number, plural, with_error

# (label, name of the number, pattern, unit)
KEY_NUMBERS = (
    ("NCPAs", "ncpa_nm", ".1f", "nm"),
    ("Defocus bias", "defocus_bias_nm", "+.1f", "nm"),
    ("Ramp slope", "ramp_slope", ".3f", ""),
    ("Seeing", "seeing_arcsec", ".2f", "arcsec"),
    ("AO residual", "ao_residual_nm", ".0f", "nm"),
    ("Image motion", "jitter_mas", ".1f", "mas"),
)
DRAWN_MODES = tuple(f"noll_{noll}_nm" for noll in range(4, 12))
DRAWN_OTHERS = (
    "ncpa_nm",
    "defocus_bias_nm",
    "ramp_slope",
    "seeing_arcsec",
    "jitter_mas",
    "gap_before",
    "gap_after",
)
MODES_CAPTION = (
    "Coefficients with errors; shaded: the band that the nights before allow; dashed: limits of the "
    "configuration; circled: outside. Modes that left their band are shown beside Noll 4 to 11."
)
OTHERS_CAPTION = (
    "Other numbers in the same way; those that depend on the sky alarm only on limits. Runs that failed "
    "their quality check are in none of these."
)
STRUCTURE_CAPTION = (
    "RMS change of the wavefront in Noll 4 and up between two calibrations, against the "
    "time between them, with its 95 % interval: flat where the NCPAs are stable, 0 where noise explains "
    "the change."
)
NEEDS_A_LOOK = "needs a look"
MAX_VERDICT_ROWS, MAX_VERDICTS = 30, 4  # rows of the table, and numbers at the top
FEW_ROWS = 12
RECORDING_COLUMNS = (
    "recording",
    "role",
    "begin (UTC)",
    "target",
    "frames",
    "window [px]",
    "exposure",
    "configuration",
)


def numbers_of_night(night: Night, trend: Trend) -> list[KeyNumber]:
    """Return the numbers at the top of the page: the last of each in `night`, from the `trend`."""
    found = [KeyNumber(*one) for one in _measured(night.date, trend)]
    gaps = _gaps(trend)
    verdicts = [one for one in trend.verdicts if one.night == night.date]
    return found + _valid_for(trend) + [_verdict_number(one, gaps) for one in verdicts[-MAX_VERDICTS:]]


def _valid_for(trend: Trend) -> list[KeyNumber]:
    """How long a calibration is valid, of the longest series."""
    series = main_series(trend, "ncpa_nm")
    validity = trend.validities.get((series.recipe, series.configuration)) if series else None
    return [] if validity is None else [KeyNumber("Calibration valid for", *validity_number(validity))]


def _verdict_number(verdict: Verdict, gaps: dict[tuple[str, str], float]) -> KeyNumber:
    before, after = (number(gaps.get((verdict.run, f"gap_{when}")), ".3f") for when in ("before", "after"))
    named = ", ".join(verdict.effects) or verdict.verdict
    note = f"{verdict.group}: gap {before} → {after}"
    return KeyNumber("Missing in the model", named, note, "bad" if verdict.verdict == "unknown" else "")


def _gaps(trend: Trend) -> dict[tuple[str, str], float]:
    """Values by run and name."""
    return {(point.run, one.name): point.value for one in trend.series for point in one.points}


def _measured(date: str, trend: Trend) -> Iterator[tuple[str, str, str]]:
    for title, name, pattern, unit in KEY_NUMBERS:
        series = main_series(trend, name)
        last = series.points[-1] if series else None
        if last is not None and last.night == date:
            yield title, with_error(last.value, last.sigma, pattern, unit), last.run.split("/")[1]


def reductions_section(night: Night) -> Section | None:
    """Return one row per job: what was done, why, and a link to its report."""
    if not night.jobs:
        return None
    rows = [_row(job, night.reduced.get(job.task.name)) for job in night.jobs]
    marks = [_mark(night.reduced.get(job.task.name)) for job in night.jobs]
    columns = ("group", "recipe", "target", "result", "what was done", "why", "report")
    return Section("reductions", "Reductions", "", [Table(columns, rows, marks=marks), *_choices(night)])


def _choices(night: Night) -> list[Table]:
    """Which calibration serves which ramp, and why."""
    chosen = {job.group.name: job.group.choice for job in night.jobs if job.group.choice}
    rows = [(name, _wrapped(choice)) for name, choice in chosen.items()]
    return [Table(("ramp", "calibration"), rows, "Calibrations of the ramps")] if rows else []


def _row(job: Job, reduced: Reduced | None) -> tuple[str, ...]:
    head = (job.group.name, job.task.recipe.stem, job.group.first.target or MISSING)
    if reduced is None:
        return (*head, "not finished", MISSING, "", "")
    took = "" if reduced.action == UNCHANGED else f" in {duration(reduced.seconds)}"
    return (
        *head,
        NEEDS_A_LOOK if reduced.status == "qc_failed" else reduced.status,
        reduced.action + took,
        _wrapped(reduced.problem or "; ".join(reduced.reasons)),
        _report_link(reduced),
    )


def _report_link(reduced: Reduced) -> str:
    if not RunFolder(reduced.folder).report.is_file():
        return MISSING
    return Markup('<a href="{}/report.html">report</a>').format(reduced.name)


def _wrapped(text: str) -> Markup:
    """Long text that may be broken into several lines of a cell."""
    return Markup('<span class="why">{}</span>').format(text)


def _mark(reduced: Reduced | None) -> str:
    if reduced is None:
        return ""
    return "good" if reduced.status == "ok" and not reduced.problem else "bad"


def verdicts_section(trend: Trend, date: str) -> Section | None:
    """Return the verdicts of `diagnose` up to the night of `date`, from the `trend`."""
    latest = [one for one in trend.verdicts if one.night <= date][-MAX_VERDICT_ROWS:]
    if not latest:
        return None
    gaps = _gaps(trend)
    rows = [
        (
            one.night,
            one.group,
            one.target or MISSING,
            one.verdict,
            ", ".join(one.effects) or MISSING,
            *(number(gaps.get((one.run, f"gap_{when}")), ".4f") for when in ("before", "after", "floor")),
        )
        for one in reversed(latest)
    ]
    columns = ("night", "group", "target", "verdict", "effects", "gap before", "gap after", "floor")
    lead = "Gap: Σ|measured − predicted| / Σ measured of frames that no fit has seen; the latest come first."
    marks = ["bad" if one.verdict == "unknown" else "" for one in reversed(latest)]
    title = plural(len(rows), "verdict")
    table = Table(columns, rows, title, marks=marks, folded=len(rows) > FEW_ROWS)
    return Section("verdicts", "What the model lacks", lead, [table])


def trend_section(trend: Trend) -> Section | None:
    """Return plots of numbers against time, and of the stability of the NCPAs; of one night its numbers."""
    if len({point.night for one in trend.series for point in one.points}) == 1:
        return Section("trend", "Trend", "One night so far: numbers without a trend.", [_numbers(trend)])
    # late: most runs of a night find nothing new, draw nothing, and need no matplotlib
    from irlos_pipe.night.trend_plots import series_drawing, structure_drawing

    modes, others = drawn(trend, DRAWN_MODES), drawn(trend, DRAWN_OTHERS)
    blocks: list[Figure | Table | Text | Stack] = []
    beside: list[Figure] = []
    if modes:
        blocks.append(Figure(series_drawing("modes", modes), "NCPAs", MODES_CAPTION))
    if others:
        beside.append(Figure(series_drawing("others", others), "Ramp, sky and model", OTHERS_CAPTION))
    if trend.structures:
        drawing = structure_drawing("structure", trend)
        said = " ".join(map(validity_text, trend.validities.values()))
        beside.append(Figure(drawing, "Stability of the NCPAs", f"{said} {STRUCTURE_CAPTION}"))
    blocks.extend([Stack(beside)] if beside else [])
    return Section("trend", "Trend", "", blocks) if blocks else None


def _numbers(trend: Trend) -> Table:
    rows = [
        (label(one.name), one.recipe, with_error(last.value, last.sigma, ".4g"), last.run.split("/")[1])
        for one in trend.series
        for last in one.points[-1:]
    ]
    return Table(("number", "recipe", "value", "group"), rows, plural(len(rows), "number"), folded=True)


def drawn(trend: Trend, names: tuple[str, ...]) -> list[Series]:
    """Return the main series of `names` in a `trend`, then others of their kind that left their band."""
    found = [main_series(trend, name) for name in names]
    out = [
        one
        for one in trend.series
        if one.alarms
        and one.name not in names
        and one.name.startswith("noll_") == names[0].startswith("noll_")
    ]
    return [one for one in (*found, *out) if one is not None]


def main_series(trend: Trend, name: str) -> Series | None:
    """Return the longest series in a `trend` of the number `name`, which several recipes may measure.

    Among series of equal length it is the one whose last point has the smallest error.
    """
    found = (one for one in trend.series if one.name == name)
    return max(found, key=lambda one: (len(one.points), -(one.points[-1].sigma or 0.0)), default=None)


def left_out_section(night: Night) -> Section | None:
    """Return the recordings that were not reduced, and why."""
    rows = [(one.recording.name, one.recording.role, _wrapped(one.reason)) for one in night.left_out]
    rows += [(one.path.name, MISSING, _wrapped(one.problem)) for one in night.unusable]
    marks = ["bad" if one.alarming else "" for one in night.left_out] + ["bad"] * len(night.unusable)
    table = Table(("recording", "role", "why"), rows, marks=marks)
    return Section("left-out", "Not reduced", "", [table]) if rows else None


def recordings_section(night: Night) -> Section | None:
    """Return the recordings in order of time."""
    if not night.recordings:
        return None
    ordered = sorted(night.recordings, key=lambda one: (one.start_unix_s or 0.0, one.name))
    rows = list(map(_recording_row, ordered))
    title = plural(len(rows), "recording")
    table = Table(RECORDING_COLUMNS, rows, title, folded=len(rows) > FEW_ROWS)
    return Section("recordings", "Recordings", "", [table])


def _recording_row(one: Description) -> tuple[str, ...]:
    rows, columns = one.window
    return (
        one.name,
        one.role,
        utc_time(one.start_unix_s) or f"not stated; night by {one.night_by}",
        one.target or MISSING,
        str(one.frames),
        f"{rows}x{columns}",
        number(one.exposure_s, "g", "s"),
        one.configuration,
    )
