"""Section on NCPAs corrected by a deformable mirror."""

from __future__ import annotations

from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.paper.common.section import mark, spread
from irlos_pipe.paper.common.variants import METHOD_NAMES
from irlos_pipe.paper.mirror_loop.results import AloneRow, LoopRow, MirrorLoopResults
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, GREEN, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural

STAGE = MirrorLoopResults.stage
COLOURS = (BLUE, GREEN, ORANGE)
PART_NAMES = {
    "finer": "finer modes",
    "fitting": "fitting error of the mirror",
    "registration": "gain and registration",
    "diversity": "diversity by the mirror",
    "estimate": "estimates",
}
ERROR_NAMES = {
    "none": "as believed",
    "gain": "gain",
    "opposite gain": "gain, the other way",
    "shift": "shift",
    "turn": "turn",
    "all": "all of them",
}
COLUMNS = (
    "calibration",
    "diversity",
    "bias [nm]",
    "before [nm]",
    "corrections",
    "left in Noll 4–30 [nm]",
    "left beyond [nm]",
    "Strehl ratio before",
    "at the end",
    "without NCPAs",
    "predicted",
    "limited by",
)
CAPTION = (
    "True wavefront over the pupil without tip and tilt [nm RMS], medians over the samples, 16th to 84th "
    "percentile in brackets. A loop ends where the estimate is not a tenth smaller than the one before. "
    "Predicted: by the stage `correct`, of the first correction."
)
FIGURE_CAPTION = "Medians over the samples whose loop came that far; one panel for each bias of the defocus."
ALONE_CAPTION = "Mirrors that are told the true wavefront before every correction; medians over all samples."


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(MirrorLoopResults)
    figure = Figure(_figure(results.rows), "What is left in Noll 4–30", FIGURE_CAPTION, "full")
    blocks: list[Block] = [figure, _table(results.rows), _parts(results.rows), _alone(results.alone)]
    return Section(STAGE, "Correction by the deformable mirror", _lead(results), blocks)


def _lead(results: MirrorLoopResults) -> str:
    rows = results.rows
    asked = [row for row in rows if row.asked_nm == row.asked_nm]
    kept = sum(row.worst_nm <= row.asked_nm for row in asked)
    return (
        f"{plural(results.samples, 'set')} of NCPAs at each bias: with a diversity as declared every sample "
        f"ends within {asked[0].asked_nm:g} nm at {kept} of {len(asked)} biases."
    )


def _loop_name(row: LoopRow) -> str:
    return f"{METHOD_NAMES[row.method]}, diversity {_diversity(row)}"


def _diversity(row: LoopRow) -> str:
    return {"exact": "as declared", "mirror": "by the mirror"}[row.diversity]


def _figure(rows: list[LoopRow]) -> Markup:
    biases = list(dict.fromkeys(row.bias_nm for row in rows))

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(biases), sharey=True, squeeze=False)[0]
        for axes, bias_nm in zip(panels, biases, strict=True):
            of_it = [row for row in rows if row.bias_nm == bias_nm]
            for row, colour in zip(of_it, COLOURS, strict=False):
                steps = [state.corrections for state in row.states]
                left_nm = [state.modes_nm.median for state in row.states]
                label = _loop_name(row) if axes is panels[0] else None
                axes.plot(steps, left_nm, "o-", color=colour, markersize=4, label=label)
            axes.set(title=f"bias {bias_nm:g} nm", xlabel="corrections", yscale="log")
        panels[0].set_ylabel("left in Noll 4–30 [nm RMS]")
        figure.legend(loc="outside upper center", ncols=1)

    return svg("mirror-loop-left", (9.5, 4.2), draw)


def _table(rows: list[LoopRow]) -> Table:
    body = [
        (
            METHOD_NAMES[row.method],
            _diversity(row),
            number(row.bias_nm, "g"),
            spread(row.before_nm, ".0f"),
            spread(row.corrections, ".0f"),
            spread(row.end_nm),
            spread(row.beyond_nm),
            *(
                number(one.median, ".3f")
                for one in (row.strehl_before, row.strehl_end, row.strehl_ideal, row.strehl_predicted)
            ),
            PART_NAMES[row.limit],
        )
        for row in rows
    ]
    marks = [mark(row.worst_nm, row.asked_nm) for row in rows]
    return Table(COLUMNS, body, "Loops", CAPTION, marks)


def _parts(rows: list[LoopRow]) -> Table:
    body = [
        (
            METHOD_NAMES[row.method],
            _diversity(row),
            number(row.bias_nm, "g"),
            *(f"{row.part_nm[part]:.1f}, {row.part_beyond_nm[part]:.1f}" for part in PART_NAMES),
        )
        for row in rows
    ]
    caption = "Left at the end in Noll 4–30, and beyond [nm RMS]; medians. The causes add up as wavefronts."
    return Table(("calibration", "diversity", "bias [nm]", *PART_NAMES.values()), body, "Causes", caption)


def _alone(rows: list[AloneRow]) -> Table:
    steps = len(rows[0].modes_nm)
    body = [
        (
            f"{row.actuators} actuators, {row.pitch_m:g} m",
            ERROR_NAMES[row.error],
            *(number(value_nm, ".2f") for value_nm in row.modes_nm),
            number(row.beyond_nm, ".1f"),
        )
        for row in rows
    ]
    columns = ("mirror", "errors", *(f"after {i} [nm]" for i in range(steps)), "beyond, end [nm]")
    return Table(columns, body, "The mirror alone", ALONE_CAPTION)
