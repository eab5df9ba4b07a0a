"""Section on the paper's first test on sky, simulated."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.estimate.ramp import travel_direction
from irlos_pipe.paper.common.section import array_of
from irlos_pipe.paper.first_tests.results import FirstTestsResults, StartRow, TargetRow, VariantRow
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, INK, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, with_error

STAGE = FirstTestsResults.stage
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
VARIANTS = {"hand_9": "kernel by hand, nine modes", "default_3": "NCPAs, AO residual, three modes"}
FIGURE_CAPTION = (
    "First ramp: estimated minus commanded defocus, that of the NCPAs taken off; line: error of the focus "
    "stage. Frames of the same offset stand side by side in order of time."
)
VARIANTS_CAPTION = (
    "Medians over the ramps. Error: against the true defocus of every frame (reached by the stage, NCPAs, AO "
    "residual). The last columns are what a user gets who knows only the commanded defocus: of the first "
    "ramp, and the RMS over all ramps of (found − true) / error."
)
STARTS_CAPTION = (
    "Wrong: did not converge, or ended more than 50 nm from the best of the minima that the starts found. "
    "Iterations: median, variances from the images."
)


def section(run: RunData) -> Section:
    """Build the section."""
    targets = run.results(FirstTestsResults).targets
    figures = [
        Figure(_ramp_figure(run, target), _title(target), FIGURE_CAPTION, "full") for target in targets
    ]
    blocks: list[Block] = [*figures, *(_variants_table(target) for target in targets), _starts_table(targets)]
    return Section(STAGE, "First test on sky, simulated", _lead(targets), blocks)


def _lead(targets: list[TargetRow]) -> str:
    errors = [
        f"{target.label} {np.median(target.variant('hand_9').rms_nm):.0f} → "
        f"{np.median(target.variant('default_3').rms_nm):.1f} nm"
        for target in targets
    ]
    return f"Median error, from the paper's estimate to this pipeline's: {', '.join(errors)}."


def _title(target: TargetRow) -> str:
    return (
        f'{target.label.capitalize()}: m_J {target.mag_j:g}, seeing {target.seeing_arcsec:g}" by '
        f'MASS-DIMM ({target.sparta_seeing_arcsec:.2g}" by SPARTA)'
    )


# -- figure --------------------------------------------------------------------------------------


def _ramp_figure(run: RunData, target: TargetRow) -> Markup:
    key = target.key
    introduced, reached, ncpa = (
        array_of(run, STAGE, f"{key}/{name}") for name in ("introduced_nm", "reached_nm", "ncpa_nm")
    )
    group = _groups(target.stage_error, introduced)

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(DRAWN), sharex=True, sharey=True)
        for axes, (variant, title) in zip(panels, DRAWN.items(), strict=True):
            difference = array_of(run, STAGE, f"{key}/{variant}/total_nm") - ncpa - introduced
            _draw_difference(axes, introduced, difference, group, GROUPS[target.stage_error])
            _draw_stage(axes, introduced, reached - introduced)
            axes.set(title=title, xlabel="commanded defocus [nm RMS]")
        panels[0].set_ylabel("estimated − commanded [nm RMS]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")

    return svg(f"first-tests-{key}", (10.5, 3.6), draw)


def _groups(stage_error: str, introduced: np.ndarray) -> np.ndarray:
    """+1 or -1 for every frame: direction of travel, or run."""
    if stage_error == "second_run_bias":
        return np.where(introduced > 0, 1, -1)
    direction = travel_direction(introduced)
    return np.where(direction == 0, np.sign(introduced), direction).astype(int)


def _draw_difference(
    axes: Axes,
    introduced: np.ndarray,
    difference: np.ndarray,
    group: np.ndarray,
    looks: dict[int, tuple[str, str, str]],
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


def _variants_table(target: TargetRow) -> Table:
    true = number(target.ways[0].stage_true_nm, "+.0f", "nm")
    columns = (
        "estimate",
        "modes",
        "slope",
        "error [nm RMS]",
        "about the line [nm RMS]",
        "kernel [mas]",
        f"{STAGE_ERRORS[target.stage_error]} (true {true}) [nm]",
        "deviation / error",
    )
    rows = [_variant_row(variant) for variant in target.ways]
    marks = ["good" if variant.key.startswith("default") else "" for variant in target.ways]
    frames = f"{target.samples} ramps of {', '.join(map(str, target.frames))} frames. "
    title = f"{target.label.capitalize()}: what each part contributes"
    return Table(columns, rows, title, frames + VARIANTS_CAPTION, marks)


def _variant_row(row: VariantRow) -> tuple[str, ...]:
    medians = (float(np.nanmedian(values)) for values in (row.rms_nm, row.line_rms_nm, row.kernel_mas))
    return (
        row.label,
        str(len(row.modes)),
        number(float(np.nanmedian(row.slope)), ".3f"),
        *(number(median) for median in medians),
        with_error(row.stage_found_nm[0], row.stage_sigma_nm[0], "+.1f"),
        number(row.pull),
    )


def _starts_table(targets: list[TargetRow]) -> Table:
    columns = ["model", "start"]
    for target in targets:
        columns += [f"{target.label}: wrong", "iterations"]
    rows = [_start_row(together) for together in zip(*(target.starts for target in targets), strict=True)]
    return Table(columns, rows, "Influence of the start", STARTS_CAPTION)


def _start_row(together: tuple[StartRow, ...]) -> list[str]:
    cells = [VARIANTS[together[0].way], STARTS[together[0].start]]
    for row in together:
        cells += [f"{row.wrong} of {row.frames}", number(row.median_iterations, ".0f")]
    return cells
