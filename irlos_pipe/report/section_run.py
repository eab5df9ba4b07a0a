"""Sections on the run: the recordings that went in, quality control, provenance."""

from collections import Counter

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import EngFormatter

from irlos_pipe.frames.recording import PROFILE
from irlos_pipe.product.product import Check
from irlos_pipe.product.results import Provenance, provenance_of
from irlos_pipe.report.content import Figure, Section, Table, Text, shown
from irlos_pipe.report.drawing import BLUE, MANY, ORANGE, figure
from irlos_pipe.report.first_screen import all_checks, check_value, passed_text
from irlos_pipe.report.images import MANY_DIGITS, thumbnail
from irlos_pipe.report.run_data import RunData, frame_times
from irlos_pipe.report.text import number, plural
from irlos_pipe.stages.correct import CorrectResults
from irlos_pipe.stages.ingest.stage import IngestResults

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
