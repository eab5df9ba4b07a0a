"""The page of a night, night_<date>.html: recordings, reductions, trend."""

from collections import Counter
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from markupsafe import Markup

from irlos_pipe.files.atomic import write_bytes, write_if_changed
from irlos_pipe.night.recordings import utc_time
from irlos_pipe.night.reduce import UNCHANGED, Job, Reduced
from irlos_pipe.night.state import Night, page_path
from irlos_pipe.night.terminal import validity_number, validity_text
from irlos_pipe.night.trend import Series, Trend, is_mode, label
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.report.content import Figure, KeyNumber, Section, Stack, Table, Text, rendered
from irlos_pipe.report.text import MISSING, duration, number, plural, with_error

TEMPLATE, INDEX_TEMPLATE, INDEX = "night.html.j2", "index.html.j2", "index.html"
FINISHED = '<meta name="irlos-night" content="finished">'
RUNNING, STOPPED, NEEDS_A_LOOK = "not finished", "stopped", "needs a look"
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
    "ncpa_nm", "defocus_bias_nm", "ramp_slope", "seeing_arcsec", "jitter_mas", "gap_before", "gap_after",
)  # fmt: skip
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
GAP_LEAD = "Gap: Σ|measured − predicted| / Σ measured of frames that no fit has seen; the latest come first."
MAX_VERDICT_ROWS, MAX_VERDICTS = 30, 4  # rows of the table, and numbers at the top
FEW_ROWS = 12  # rows above which a table is folded
REDUCTION_COLUMNS = ("group", "recipe", "target", "result", "what was done", "why", "report")
INDEX_NUMBERS = ("chi2_nu", "ncpa_nm", "defocus_bias_nm")
INDEX_COLUMNS = (
    "night", "reduction", "target", "result", "checks passed", "χ²/ν", "NCPAs [nm]", "defocus bias [nm]",
    "diagnosis",
)  # fmt: skip


def write_page(tree: Path, night: Night, trend: Trend | None, running: bool = False) -> None:
    """Write the page of a `night` into the `tree`, with the `trend` as it was after it, if it is given.

    While the night is being reduced, `running`, the page says so, also in case this process is killed.
    """
    shown, status = trend or Trend(), RUNNING if running else _status(night)
    sections = (
        _reductions(night), _verdicts(shown, night.date), trend_section(shown), _left_out(night),
        _recordings(night),
    )  # fmt: skip
    actions = Counter(one.action for one in night.reduced.values())
    found = [plural(len(night.recordings), "recording"), plural(len(night.jobs), "reduction")]
    page = rendered(
        TEMPLATE,
        date=night.date,
        status=status,
        running=running,
        night=night,
        finished="" if status in (RUNNING, STOPPED) else FINISHED,
        written=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        summary=", ".join([*found, *(f"{count} {action}" for action, count in actions.items())]),
        key_numbers=numbers_of_night(night, shown),
        sections=list(filter(None, sections)),
    )
    write_bytes(page_path(tree, night.date), page.encode("utf-8", "backslashreplace"))


def write_index(tree: Path, reductions: Iterable[Mapping[str, Any]]) -> None:
    """Write the list of all nights of a `tree`, of its pages and `reductions`, the latest first."""
    by_night: dict[str, list[Mapping[str, Any]]] = {
        page.stem.removeprefix("night_"): [] for page in tree.glob("night_*.html")
    }
    for one in reductions:
        by_night.setdefault(one["night"], []).append(one)
    rows, marks = [], []
    for date, members in sorted(by_night.items(), reverse=True):
        for one in members or [{}]:
            link = Markup('<a href="night_{0}.html">{0}</a>').format(date)
            rows.append((link, *(_listed(one) if one else ["no reduction", *[""] * 7])))
            marks.append({"": "", "ok": "good"}.get(one.get("status", ""), "bad"))
    table = Table(INDEX_COLUMNS, rows, plural(len(by_night), "night"), marks=marks)
    page = rendered(INDEX_TEMPLATE, sections=[Section("nights", "Nights", "", [table])])
    write_if_changed(tree / INDEX, page.encode("utf-8", "backslashreplace"))


def _listed(one: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        Markup('<a href="{}/report.html">{}</a>').format(one["run"], one["run"].partition("/")[2]),
        one["target"] or MISSING,
        NEEDS_A_LOOK if one["status"] == "qc_failed" else one["status"],
        f"{one['passed'] or 0} of {one['checks']}",
        *(with_error(one[name][0], one[name][1], ".3g") if name in one else "" for name in INDEX_NUMBERS),
        one["verdict"] or "",
    )


def _status(night: Night) -> str:
    if night.stopped:
        return STOPPED
    if night.nothing:
        return "empty"
    return NEEDS_A_LOOK if night.failures or night.doubts else "ok"


def numbers_of_night(night: Night, trend: Trend) -> list[KeyNumber]:
    """Return the numbers at the top of the page: the last of each in `night`, from the `trend`."""
    found = []
    for title, name, pattern, unit in KEY_NUMBERS:
        series = main_series(trend, name)
        if series and series.last.night == night.date:
            value = with_error(series.last.value, series.last.sigma, pattern, unit)
            found.append(KeyNumber(title, value, _group(series)))
    longest = main_series(trend, "ncpa_nm")
    if longest and longest.owner in trend.stabilities:
        _, validity = trend.stabilities[longest.owner]
        found.append(KeyNumber("Calibration valid for", *validity_number(validity)))
    gaps = _gaps(trend)
    for one in [one for one in trend.verdicts if one.night == night.date][-MAX_VERDICTS:]:
        before, after = (number(gaps.get((one.run, f"gap_{when}")), ".3f") for when in ("before", "after"))
        named, note = ", ".join(one.effects) or one.verdict, f"{one.group}: gap {before} → {after}"
        found.append(
            KeyNumber("Missing in the model", named, note, "bad" if one.verdict == "unknown" else "")
        )
    return found


def _group(series: Series) -> str:
    return series.last.run.split("/")[1]


def _gaps(trend: Trend) -> dict[tuple[str, str], float]:
    return {(point.run, point.name): point.value for point in trend.points}


def _reductions(night: Night) -> Section | None:
    """One row per job: what was done, why, and a link to its report; and which calibration serves a ramp."""
    if not night.jobs:
        return None
    rows = [_reduction(job, night.reduced.get(job.task.name)) for job in night.jobs]
    marks = [mark for mark, _ in rows]
    tables = [Table(REDUCTION_COLUMNS, [row for _, row in rows], marks=marks)]
    chosen = {job.group.name: _wrapped(job.group.choice) for job in night.jobs if job.group.choice}
    if chosen:
        tables.append(Table(("ramp", "calibration"), list(chosen.items()), "Calibrations of the ramps"))
    return Section("reductions", "Reductions", "", tables)


def _reduction(job: Job, reduced: Reduced | None) -> tuple[str, tuple[str, ...]]:
    """Mark and cells of a row."""
    head = (job.group.name, job.task.recipe.stem, job.group.first.target or MISSING)
    if reduced is None:
        return "", (*head, "not finished", MISSING, "", "")
    link = MISSING
    if RunFolder(reduced.folder).report.is_file():
        link = Markup('<a href="{}/report.html">report</a>').format(reduced.name)
    row = (
        *head,
        NEEDS_A_LOOK if reduced.status == "qc_failed" else reduced.status,
        reduced.action + ("" if reduced.action == UNCHANGED else f" in {duration(reduced.seconds)}"),
        _wrapped(reduced.problem or "; ".join(reduced.reasons)),
        link,
    )
    return "good" if reduced.status == "ok" and not reduced.problem else "bad", row


def _wrapped(text: str) -> Markup:
    """Long text that may be broken into several lines of a cell."""
    return Markup('<span class="why">{}</span>').format(text) if text else Markup("")


def _verdicts(trend: Trend, date: str) -> Section | None:
    """The verdicts of `diagnose` up to the night of `date`."""
    latest = [one for one in trend.verdicts if one.night <= date][-MAX_VERDICT_ROWS:][::-1]
    gaps = _gaps(trend)
    table = Table.of(
        latest,
        {
            "night": lambda one: one.night,
            "group": lambda one: one.group,
            "target": lambda one: one.target or MISSING,
            "verdict": lambda one: one.verdict,
            "effects": lambda one: ", ".join(one.effects) or MISSING,
            "gap before": lambda one: number(gaps.get((one.run, "gap_before")), ".4f"),
            "gap after": lambda one: number(gaps.get((one.run, "gap_after")), ".4f"),
            "floor": lambda one: number(gaps.get((one.run, "gap_floor")), ".4f"),
        },
        plural(len(latest), "verdict"),
        marks=["bad" if one.verdict == "unknown" else "" for one in latest],
        folded=len(latest) > FEW_ROWS,
    )
    return Section("verdicts", "What the model lacks", GAP_LEAD, [table]) if latest else None


def trend_section(trend: Trend) -> Section | None:
    """Return plots of numbers against time, and of the stability of the NCPAs; of one night its numbers."""
    if len({point.night for point in trend.points}) == 1:
        return Section("trend", "Trend", "One night so far: numbers without a trend.", [_numbers(trend)])
    # late: most runs of a night find nothing new, draw nothing, and need no matplotlib
    from irlos_pipe.night.trend_plots import series_drawing, structure_drawing

    modes, others = _drawn(trend, DRAWN_MODES), _drawn(trend, DRAWN_OTHERS)
    blocks: list[Figure | Table | Text | Stack] = []
    side_by_side: list[Figure] = []
    if modes:
        blocks.append(Figure(series_drawing("modes", modes), "NCPAs", MODES_CAPTION))
    if others:
        side_by_side.append(Figure(series_drawing("others", others), "Ramp, sky and model", OTHERS_CAPTION))
    if trend.stabilities:
        drawing = structure_drawing("structure", trend)
        said = " ".join(validity_text(validity) for _, validity in trend.stabilities.values())
        side_by_side.append(Figure(drawing, "Stability of the NCPAs", f"{said} {STRUCTURE_CAPTION}"))
    blocks.extend([Stack(side_by_side)] if side_by_side else [])
    return Section("trend", "Trend", "", blocks) if blocks else None


def _numbers(trend: Trend) -> Table:
    rows = [
        (label(one.name), one.last.recipe, with_error(one.last.value, one.last.sigma, ".4g"), _group(one))
        for one in trend.series
    ]
    return Table(("number", "recipe", "value", "group"), rows, plural(len(rows), "number"), folded=True)


def _drawn(trend: Trend, names: tuple[str, ...]) -> list[Series]:
    """The main series of `names`, then others of their kind that left their band."""
    found = (main_series(trend, name) for name in names)
    others = (one for one in trend.series if one.name not in names and one.alarms)
    out = (one for one in others if is_mode(one.name) == is_mode(names[0]))
    return [one for one in (*found, *out) if one is not None]


def main_series(trend: Trend, name: str) -> Series | None:
    """Return the longest series in a `trend` of the number `name`, which several recipes may measure.

    Among series of equal length it is the one whose last point has the smallest error.
    """
    found = (one for one in trend.series if one.name == name)
    return max(found, key=lambda one: (len(one.points), -(one.last.sigma or 0.0)), default=None)


def _left_out(night: Night) -> Section | None:
    left = [*night.not_reduced, *night.unusable]
    rows = [(one.recording.name, one.recording.role or MISSING, _wrapped(one.reason)) for one in left]
    table = Table(("recording", "role", "why"), rows, marks=["bad" if one.alarming else "" for one in left])
    return Section("left-out", "Not reduced", "", [table]) if rows else None


def _recordings(night: Night) -> Section | None:
    ordered = sorted(night.recordings, key=lambda one: (one.start_unix_s or 0.0, one.name))
    table = Table.of(
        ordered,
        {
            "recording": lambda one: one.name,
            "role": lambda one: one.role,
            "begin (UTC)": lambda one: utc_time(one.start_unix_s) or f"not stated; night by {one.night_by}",
            "target": lambda one: one.target or MISSING,
            "frames": lambda one: str(one.frames),
            "window [px]": lambda one: f"{one.window[0]}x{one.window[1]}",
            "exposure": lambda one: number(one.exposure_s, "g", "s"),
            "configuration": lambda one: one.configuration,
        },
        plural(len(ordered), "recording"),
        folded=len(ordered) > FEW_ROWS,
    )
    return Section("recordings", "Recordings", "", [table]) if ordered else None
