"""Section on the paper's first test on sky, simulated."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.estimate.ramp import travel_direction
from irlos_pipe.report.content import Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, INK, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, with_error

STAGE = "first_tests"
DRAWN = {
    "hand_9": "as in the paper: kernel by hand, nine modes",
    "default_3": "this pipeline: NCPAs, AO residual, three modes",
}
GROUPS = {
    "saw_tooth": {1: ("reached upwards", "^", ORANGE), -1: ("reached downwards", "v", BLUE)},
    "second_run_bias": {1: ("second run", "^", ORANGE), -1: ("first run", "v", BLUE)},
}
STAGE_ERRORS = {"saw_tooth": "saw-tooth", "second_run_bias": "bias of the second run"}
STARTS = {
    "zero": "zero",
    "elongation": "elongation prior",
    "scan": "scan of defocus",
    "default": "elongation, outliers again from the scan",
}
WAYS = {"hand_9": "kernel by hand, nine modes", "default_3": "NCPAs, AO residual, three modes"}
FIGURE_CAPTION = (
    "First ramp: estimated minus told defocus, that of the NCPAs taken off; line: what the focus stage did. "
    "Frames of the same offset stand side by side in order of time."
)
WAYS_CAPTION = (
    "Medians over the ramps. Error: against the true defocus of every frame (reached by the stage, NCPAs, AO "
    "residual). The last columns are what a user gets who knows only what the stage was told: of the first "
    "ramp, and the RMS over all ramps of (found − true) / error."
)
STARTS_CAPTION = (
    "Wrong: did not converge, or ended more than 50 nm from the best of the minima that the starts found. "
    "Iterations: median, variances from the images."
)


def section(run: RunData) -> Section:
    """Build the section."""
    targets = run.results(STAGE).get("targets", [])
    figures = [
        Figure(_ramp_figure(run, target), _title(target), FIGURE_CAPTION, "full") for target in targets
    ]
    blocks = [*figures, *(_ways_table(target) for target in targets), _starts_table(targets)]
    return Section(STAGE, "First test on sky, simulated", _lead(targets), blocks)


def _lead(targets: list[dict[str, Any]]) -> str:
    told = [
        f"{target['label']} {np.median(_way(target, 'hand_9')['rms_nm']):.0f} → "
        f"{np.median(_way(target, 'default_3')['rms_nm']):.1f} nm"
        for target in targets
    ]
    return f"Median error, from the paper's way to this pipeline: {', '.join(told)}."


def _way(target: dict[str, Any], key: str) -> dict[str, Any]:
    return next(way for way in target["ways"] if way["key"] == key)


def _title(target: dict[str, Any]) -> str:
    return (
        f'{target["label"].capitalize()}: m_J {target["mag_j"]:g}, seeing {target["seeing_arcsec"]:g}" by '
        f'MASS-DIMM ({target["sparta_seeing_arcsec"]:.2g}" by SPARTA)'
    )


# -- figure --------------------------------------------------------------------------------------


def _ramp_figure(run: RunData, target: dict[str, Any]) -> Markup:
    key = target["key"]
    introduced, reached, ncpa = (
        run.array(STAGE, f"{key}/{name}") for name in ("introduced_nm", "reached_nm", "ncpa_nm")
    )
    group = _groups(target["stage_error"], introduced)

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(DRAWN), sharex=True, sharey=True)
        for axes, (way, title) in zip(panels, DRAWN.items(), strict=True):
            difference = run.array(STAGE, f"{key}/{way}/total_nm") - ncpa - introduced
            _draw_difference(axes, introduced, difference, group, GROUPS[target["stage_error"]])
            _draw_stage(axes, introduced, reached - introduced)
            axes.set(title=title, xlabel="told defocus [nm RMS]")
        panels[0].set_ylabel("estimated − told [nm RMS]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")

    return svg(f"first-tests-{key}", (10.5, 3.6), draw)


def _groups(stage_error: str, introduced: np.ndarray) -> np.ndarray:
    """+1 or -1 for every frame: direction of travel, or run."""
    if stage_error == "second_run_bias":
        return np.where(introduced > 0, 1, -1)
    direction = travel_direction(introduced)
    return np.where(direction == 0, np.sign(introduced), direction).astype(int)


def _draw_difference(
    axes: Axes, introduced, difference, group, looks: dict[int, tuple[str, str, str]]
) -> None:
    x = _side_by_side(introduced)
    for sign, (label, marker, colour) in looks.items():
        chosen = group == sign
        axes.plot(x[chosen], difference[chosen], marker, color=colour, markersize=3.5, label=label)


def _side_by_side(introduced: np.ndarray) -> np.ndarray:
    """Frames of one offset next to each other, in order of time."""
    offsets, place, count = np.unique(introduced, return_inverse=True, return_counts=True)
    rank = np.array([np.sum(place[:i] == place[i]) for i in range(len(place))])
    step = np.min(np.diff(offsets)) if len(offsets) > 1 else 1.0
    return introduced + 0.5 * step * ((rank + 0.5) / count[place] - 0.5)


def _draw_stage(axes: Axes, introduced: np.ndarray, error: np.ndarray) -> None:
    order = np.argsort(introduced, kind="stable")
    axes.step(introduced[order], error[order], where="mid", color=INK, linewidth=1.0, label="focus stage")


# -- tables --------------------------------------------------------------------------------------


def _ways_table(target: dict[str, Any]) -> Table:
    what = STAGE_ERRORS[target["stage_error"]]
    true = number(target["ways"][0]["stage_true_nm"], "+.0f", "nm")
    columns = (
        "estimate",
        "modes",
        "slope",
        "error [nm RMS]",
        "about the line [nm RMS]",
        "kernel [mas]",
        f"{what} (true {true}) [nm]",
        "deviation / error",
    )
    rows = [_way_row(way) for way in target["ways"]]
    marks = ["good" if way["key"].startswith("default") else "" for way in target["ways"]]
    frames = f"{target['samples']} ramps of {', '.join(map(str, target['frames']))} frames. "
    return Table(
        columns, rows, f"{target['label'].capitalize()}: what each part buys", frames + WAYS_CAPTION, marks
    )


def _way_row(way: dict[str, Any]) -> tuple[str, ...]:
    slope, rms, line, kernel = (
        _median(way[name]) for name in ("slope", "rms_nm", "line_rms_nm", "kernel_mas")
    )
    return (
        way["label"],
        str(len(way["modes"])),
        number(slope, ".3f"),
        number(rms),
        number(line),
        number(kernel),
        with_error(way["stage_found_nm"][0], way["stage_sigma_nm"][0], "+.1f"),
        number(_pull(way)),
    )


def _median(values: list[float | None]) -> float:
    return float(np.nanmedian(np.array(values, float)))


def _pull(way: dict[str, Any]) -> float:
    """RMS over the ramps of the deviation from the truth in units of the quoted error."""
    found, sigma = (np.array(way[name], float) for name in ("stage_found_nm", "stage_sigma_nm"))
    return float(np.sqrt(np.mean(((found - way["stage_true_nm"]) / sigma) ** 2)))


def _starts_table(targets: list[dict[str, Any]]) -> Table:
    columns = ["model", "start"]
    for target in targets:
        columns += [f"{target['label']}: wrong", "iterations"]
    keys = [(row["way"], row["start"]) for row in targets[0]["starts"]] if targets else []
    rows = [_start_row(targets, *key) for key in keys]
    return Table(columns, rows, "What the start buys", STARTS_CAPTION)


def _start_row(targets: list[dict[str, Any]], way: str, start: str) -> list[str]:
    cells = [WAYS[way], STARTS[start]]
    for target in targets:
        row = next(one for one in target["starts"] if (one["way"], one["start"]) == (way, start))
        cells += [f"{row['wrong']} of {row['frames']}", number(row["median_iterations"], ".0f")]
    return cells
