"""Section on the comparison of calibration methods on simulated cubes."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.report.content import Figure, Section, Table
from irlos_pipe.report.drawing import CYCLE, FAINT, INK, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, number, plural

STAGE = "methods"
MODEL_SHAPE = "power_law"
PUBLISHED = ("dip_global", "lift_slices", "dip_joint", "lift_avg", "dip_avg")
DEFAULT = "long_exposure"
DRAWN = (DEFAULT, *PUBLISHED)
MARKERS = ("o", "s", "^", "D", "v", "P")
NAMES = {
    DEFAULT: "this pipeline's default",
    "dip_global": "DIP global (the paper's choice)",
    "lift_slices": "LIFT slices",
    "dip_joint": "DIP joint",
    "lift_avg": "LIFT avg.",
    "dip_avg": "DIP avg.",
}
SHAPES = {
    "power_law": "power law, as modelled",
    "servo_lag": "servo lag along the wind",
    "aliasing": "aliasing",
    "non_stationary": "non-stationary seeing",
}


def section(run: RunData) -> Section:
    """Build the section."""
    conditions = run.results(STAGE).get("conditions", [])
    if not conditions:
        return Section(STAGE, "Calibration methods")
    modelled = [row for row in conditions if row["shape"] == MODEL_SHAPE]
    full = [row for row in modelled if "parts" in row]
    blocks = [
        Figure(_against_seeing(modelled), "Error against seeing", SEEING_CAPTION, "half"),
        Figure(_distributions(run, full), "Distribution over cubes", SAMPLES_CAPTION, "half"),
        _method_table(full),
        _parts_table(full, run.results(STAGE)["labels"]),
        _shape_table(conditions),
    ]
    return Section(STAGE, "Calibration methods", _lead(modelled), blocks)


SEEING_CAPTION = (
    "Median Δ-WFE in Noll 2–30; bars: 16th to 84th percentile over cubes. Grey: NCPAs introduced. Dashes: "
    "floor from the finite number of speckles in a cube, the part of the default's error that falls "
    "as 1/√frames."
)
SAMPLES_CAPTION = "Every point is a cube with NCPAs of its own; Δ-WFE in Noll 2–30, bars at the medians."


def _lead(modelled: list[dict[str, Any]]) -> str:
    ratios = [row["ratio_to_dip_global"] for row in modelled]
    worst = max(ratios)
    return (
        f"Against the published choice, DIP global, the default leaves {worst:.0%} of the error "
        f"in the 29 modes or less (ratio of the medians at {plural(len(ratios), 'seeing')})."
    )


def _against_seeing(rows: list[dict[str, Any]]) -> Markup:
    rows = sorted(rows, key=lambda row: row["seeing_arcsec"])
    seeing = np.array([row["seeing_arcsec"] for row in rows])

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        _draw_introduced(axes, seeing, rows)
        for place, name in enumerate(DRAWN):
            _draw_method(axes, seeing, rows, name, CYCLE[place % len(CYCLE)], MARKERS[place])
        floor = [row.get("speckle_floor_nm", np.nan) for row in rows]
        axes.plot(seeing, floor, "_", color=INK, markersize=16, label="speckle floor")
        axes.set(xlabel='seeing ["]', ylabel="Δ-WFE in Noll 2–30 [nm RMS]", yscale="log")
        figure.legend(loc="outside upper center", ncols=2)

    return svg("methods-seeing", (5.2, 4.6), draw)


def _draw_introduced(axes: Axes, seeing: np.ndarray, rows: list[dict[str, Any]]) -> None:
    mean = np.array([row["introduced_nm"] for row in rows])
    scatter = np.array([row["introduced_scatter_nm"] for row in rows])
    axes.plot(seeing, mean, "--", color=INK, linewidth=0.9, label="introduced")
    axes.fill_between(seeing, mean - scatter, mean + scatter, color=FAINT, alpha=0.5, linewidth=0)


def _draw_method(axes: Axes, seeing, rows, name: str, colour: str, marker: str) -> None:
    found = [row["modes"].get(name, {}) for row in rows]
    median, low, high = (
        np.array([one.get(key, np.nan) for one in found]) for key in ("median_nm", "p16_nm", "p84_nm")
    )
    axes.errorbar(
        seeing,
        median,
        [median - low, high - median],
        fmt=f"{marker}-",
        color=colour,
        markersize=4,
        label=NAMES[name],
    )


def _distributions(run: RunData, rows: list[dict[str, Any]]) -> Markup:
    seeing, shape = run.array(STAGE, "samples/seeing_arcsec"), run.array(STAGE, "samples/shape").astype(str)

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, max(len(rows), 1), sharey=True, squeeze=False)[0]
        for axes, row in zip(panels, rows, strict=False):
            chosen = (seeing == row["seeing_arcsec"]) & (shape == MODEL_SHAPE)
            for place, name in enumerate(DRAWN):
                values = run.array(STAGE, f"samples/{name}/modes_nm")[chosen]
                _draw_points(axes, place, values, CYCLE[place % len(CYCLE)], MARKERS[place])
            axes.set(title=f'{row["seeing_arcsec"]:g}"', yscale="log")
            axes.set_xticks(range(len(DRAWN)), DRAWN, rotation=45, ha="right")
        panels[0].set_ylabel("Δ-WFE in Noll 2–30 [nm RMS]")

    return svg("methods-samples", (5.2, 4.6), draw)


def _draw_points(axes: Axes, place: int, values: np.ndarray, colour: str, marker: str) -> None:
    spread = place + 0.3 * (np.arange(len(values)) / max(len(values) - 1, 1) - 0.5)
    axes.plot(spread, values, marker, color=colour, markersize=3, alpha=0.7)
    axes.hlines(np.median(values), place - 0.35, place + 0.35, color=INK, linewidth=1.2)


def _method_table(rows: list[dict[str, Any]]) -> Table:
    columns = ["method"]
    for row in rows:
        columns += [f'{row["seeing_arcsec"]:g}", 29 modes', f'{row["seeing_arcsec"]:g}", full pupil']
    body = [
        [NAMES[name]] + [_spread(row[kind].get(name)) for row in rows for kind in ("modes", "pupil")]
        for name in DRAWN
    ]
    sizes = ", ".join(f'{row["samples"]} at {row["seeing_arcsec"]:g}"' for row in rows)
    caption = f"Median Δ-WFE [nm RMS] and 16th to 84th percentile over cubes ({sizes})."
    return Table(columns, body, "Δ-WFE of every method", caption, ["good"] + [""] * len(PUBLISHED))


def _parts_table(rows: list[dict[str, Any]], labels: dict[str, str]) -> Table:
    columns = ["calibration"]
    for row in rows:
        columns += [f'{row["seeing_arcsec"]:g}" [nm]', "χ²/ν"]
    names = [name for name in labels if any(name in row["parts"] for row in rows)]
    body = [
        [labels[name]]
        + [text for row in rows for text in (_median(row, name), number(row["chi2_nu"][name], ".2f"))]
        for name in names
    ]
    body.append(["speckle floor of the cube", *_floors(rows, "speckle_floor_nm")])
    body.append(["beside it, with endless frames", *_floors(rows, "beside_floor_nm")])
    counts = "/".join(str(row["parts"][DEFAULT]["samples"]) for row in rows)
    caption = (
        "Median Δ-WFE in Noll 2–30 with one part of the default changed, and median χ²/ν of the mean image; "
        f"the first {counts} cubes of each seeing."
    )
    return Table(columns, body, "What each part of the default buys", caption)


def _floors(rows: list[dict[str, Any]], key: str) -> list[str]:
    return [text for row in rows for text in (number(row.get(key)), "")]


def _shape_table(conditions: list[dict[str, Any]]) -> Table:
    body = [
        [
            SHAPES.get(row["shape"], row["shape"]),
            f'{row["seeing_arcsec"]:g}"',
            _spread(row["modes"].get(DEFAULT)),
            number(_median_of(row, "elliptic_residual")),
            number(_median_of(row, "round_residual")),
            _spread(row["modes"].get("dip_global")),
            number(row["ratio_to_dip_global"], ".2f"),
            str(row["samples"]),
        ]
        for row in conditions
    ]
    columns = (
        "AO residual",
        "seeing",
        "default [nm]",
        "one axis only",
        "no direction",
        "DIP global [nm]",
        "ratio",
        "cubes",
    )
    marks = ["good" if row["ratio_to_dip_global"] <= 0.25 else "bad" for row in conditions]
    caption = (
        "Δ-WFE in Noll 2–30, also where the residual's power spectrum is not of the modelled family; "
        "the default's residual has two axes and four arms of free strength and direction."
    )
    return Table(columns, body, "Other AO residuals", caption, marks)


def _median(row: dict[str, Any], name: str) -> str:
    return number(row["parts"][name]["median_nm"]) if name in row["parts"] else MISSING


def _median_of(row: dict[str, Any], name: str) -> float | None:
    return row.get("parts", row["modes"]).get(name, row["modes"].get(name, {})).get("median_nm")


def _spread(found: dict[str, float] | None) -> str:
    if found is None:
        return MISSING
    return f"{found['median_nm']:.1f} ({found['p16_nm']:.1f}–{found['p84_nm']:.1f})"
