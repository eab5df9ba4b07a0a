"""Section on the comparison of calibration methods on simulated cubes."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.paper.common.section import array_of
from irlos_pipe.paper.common.variants import DEFAULT, METHOD_NAMES, PAPER_CHOICE, PUBLISHED
from irlos_pipe.paper.methods.results import ConditionRow, Distribution, MethodsResults
from irlos_pipe.paper.methods.stage import MODEL_SHAPE
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import CYCLE, FAINT, INK, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, number, plural

STAGE = MethodsResults.stage
DRAWN = tuple(METHOD_NAMES)
MARKERS = ("o", "s", "^", "D", "v", "P")
NAMES = METHOD_NAMES | {PAPER_CHOICE: f"{METHOD_NAMES[PAPER_CHOICE]} (the paper's choice)"}
SHAPES: dict[str, str] = {
    MODEL_SHAPE: "power law, as modelled",
    "servo_lag": "servo lag along the wind",
    "aliasing": "aliasing",
    "non_stationary": "non-stationary seeing",
}
SEEING_CAPTION = (
    "Median Δ-WFE in Noll 2–30; bars: 16th to 84th percentile over cubes. Grey: NCPAs introduced. Dashes: "
    "floor from the finite number of speckles in a cube, the part of the default's error that falls "
    "as 1/√frames."
)
SAMPLES_CAPTION = "Every point is a cube with NCPAs of its own; Δ-WFE in Noll 2–30, bars at the medians."


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(MethodsResults)
    modelled = [row for row in results.conditions if row.shape == MODEL_SHAPE]
    full = [row for row in modelled if row.parts]
    blocks: list[Block] = [
        Figure(_against_seeing(modelled), "Error against seeing", SEEING_CAPTION, "half"),
        Figure(_distributions(run, full), "Distribution over cubes", SAMPLES_CAPTION, "half"),
        _method_table(full),
        _parts_table(full, results.labels),
        _shape_table(results.conditions),
    ]
    return Section(STAGE, "Calibration methods", _lead(modelled), blocks)


def _lead(modelled: list[ConditionRow]) -> str:
    ratios = [row.ratio_to_dip_global for row in modelled]
    worst = max(ratios)
    return (
        f"Against the published choice, DIP global, the default leaves {worst:.0%} of the error "
        f"in the 29 modes or less (ratio of the medians at {plural(len(ratios), 'seeing')})."
    )


def _against_seeing(rows: list[ConditionRow]) -> Markup:
    rows = sorted(rows, key=lambda row: row.seeing_arcsec)
    seeing = np.array([row.seeing_arcsec for row in rows])

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        _draw_introduced(axes, seeing, rows)
        for place, name in enumerate(DRAWN):
            _draw_method(axes, seeing, rows, name, CYCLE[place % len(CYCLE)], MARKERS[place])
        floor = [row.speckle_floor_nm for row in rows]
        axes.plot(seeing, floor, "_", color=INK, markersize=16, label="speckle floor")
        axes.set(xlabel='seeing ["]', ylabel="Δ-WFE in Noll 2–30 [nm RMS]", yscale="log")
        figure.legend(loc="outside upper center", ncols=2)

    return svg("methods-seeing", (5.2, 4.6), draw)


def _draw_introduced(axes: Axes, seeing: np.ndarray, rows: list[ConditionRow]) -> None:
    mean = np.array([row.introduced_nm for row in rows])
    scatter = np.array([row.introduced_scatter_nm for row in rows])
    axes.plot(seeing, mean, "--", color=INK, linewidth=0.9, label="introduced")
    axes.fill_between(seeing, mean - scatter, mean + scatter, color=FAINT, alpha=0.5, linewidth=0)


def _draw_method(
    axes: Axes, seeing: np.ndarray, rows: list[ConditionRow], name: str, colour: str, marker: str
) -> None:
    found = [row.modes.get(name, Distribution()) for row in rows]
    median, low, high = np.array([(one.median_nm, one.p16_nm, one.p84_nm) for one in found]).T
    axes.errorbar(
        seeing,
        median,
        [median - low, high - median],
        fmt=f"{marker}-",
        color=colour,
        markersize=4,
        label=NAMES[name],
    )


def _distributions(run: RunData, rows: list[ConditionRow]) -> Markup:
    seeing, shape = (array_of(run, STAGE, f"samples/{name}") for name in ("seeing_arcsec", "shape"))

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, max(len(rows), 1), sharey=True, squeeze=False)[0]
        for axes, row in zip(panels, rows, strict=False):
            chosen = (seeing == row.seeing_arcsec) & (shape.astype(str) == MODEL_SHAPE)
            for place, name in enumerate(DRAWN):
                values = array_of(run, STAGE, f"samples/{name}/modes_nm")[chosen]
                _draw_points(axes, place, values, CYCLE[place % len(CYCLE)], MARKERS[place])
            axes.set(title=f'{row.seeing_arcsec:g}"', yscale="log")
            axes.set_xticks(range(len(DRAWN)), DRAWN, rotation=45, ha="right")
        panels[0].set_ylabel("Δ-WFE in Noll 2–30 [nm RMS]")

    return svg("methods-samples", (5.2, 4.6), draw)


def _draw_points(axes: Axes, place: int, values: np.ndarray, colour: str, marker: str) -> None:
    spread = place + 0.3 * (np.arange(len(values)) / max(len(values) - 1, 1) - 0.5)
    axes.plot(spread, values, marker, color=colour, markersize=3, alpha=0.7)
    axes.hlines(np.median(values), place - 0.35, place + 0.35, color=INK, linewidth=1.2)


def _method_table(rows: list[ConditionRow]) -> Table:
    columns = ["method"]
    for row in rows:
        columns += [f'{row.seeing_arcsec:g}", 29 modes', f'{row.seeing_arcsec:g}", full pupil']
    body = [
        [NAMES[name]]
        + [_median_in_range(found.get(name)) for row in rows for found in (row.modes, row.pupil)]
        for name in DRAWN
    ]
    sizes = ", ".join(f'{row.samples} at {row.seeing_arcsec:g}"' for row in rows)
    caption = f"Median Δ-WFE [nm RMS] and its range of 90 % by bootstrap over the cubes ({sizes})."
    return Table(columns, body, "Δ-WFE of every method", caption, ["good"] + [""] * len(PUBLISHED))


def _parts_table(rows: list[ConditionRow], labels: dict[str, str]) -> Table:
    columns = ["calibration"]
    for row in rows:
        columns += [f'{row.seeing_arcsec:g}" [nm]', "χ²/ν"]
    names = [name for name in labels if any(name in row.parts for row in rows)]
    body = [
        [labels[name]]
        + [text for row in rows for text in (_median(row.parts, name), number(row.chi2_nu[name], ".2f"))]
        for name in names
    ]
    for text, floors in (
        ("speckle floor of the cube", [row.speckle_floor_nm for row in rows]),
        ("beside it, with endless frames", [row.beside_floor_nm for row in rows]),
    ):
        body.append([text, *(cell for floor in floors for cell in (number(floor), ""))])
    counts = "/".join(str(row.parts[DEFAULT].samples) for row in rows)
    caption = (
        "Median Δ-WFE in Noll 2–30 with one part of the default changed, and median χ²/ν of the mean image; "
        f"the first {counts} cubes of each seeing."
    )
    return Table(columns, body, "What each part of the default contributes", caption)


def _shape_table(conditions: list[ConditionRow]) -> Table:
    body = [
        [
            SHAPES.get(row.shape, row.shape),
            f'{row.seeing_arcsec:g}"',
            _median_in_range(row.modes.get(DEFAULT)),
            _median_in_range(row.modes.get(PAPER_CHOICE)),
            number(row.ratio_to_dip_global, ".2f"),
            str(row.samples),
        ]
        for row in conditions
    ]
    columns = (
        "AO residual",
        "seeing",
        "default [nm]",
        "DIP global [nm]",
        "ratio",
        "cubes",
    )
    marks = ["good" if row.ratio_to_dip_global <= 0.25 else "bad" for row in conditions]
    caption = (
        "Median Δ-WFE in Noll 2–30 and its range of 90 % by bootstrap over the cubes, also where the "
        "residual's power spectrum is not of the modelled family; "
        "the default's residual has two axes and four arms of free strength and direction."
    )
    return Table(columns, body, "Other AO residuals", caption, marks)


def _median(found: dict[str, Distribution], name: str) -> str:
    return number(found[name].median_nm) if name in found else MISSING


def _median_in_range(found: Distribution | None) -> str:
    if found is None:
        return MISSING
    return f"{found.median_nm:.1f} ({found.low_nm:.1f}–{found.high_nm:.1f})"
