"""Section on the simulated derotator test: maps per angle, parts against the truth, by two methods."""

from __future__ import annotations

import numpy as np

from irlos_pipe.paper.common.section import array_of
from irlos_pipe.paper.common.variants import METHOD_NAMES
from irlos_pipe.paper.derotator_series.results import DerotatorSeriesResults, MethodRow
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_derotator import maps_figure
from irlos_pipe.report.text import number
from irlos_pipe.report.wavefront_plots import common_limit_nm, wavefront_grid

STAGE = DerotatorSeriesResults.stage
ERROR_COLUMNS = {
    "single angle": "single_nm",
    "two parts": "model_nm",
    "turning part": "rotating_nm",
    "fixed part": "fixed_nm",
    "symmetric modes": "unsplit_nm",
    "turning part, all modes": "rotating_all_nm",
}


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(DerotatorSeriesResults)
    blocks: list[Block] = []
    for place, method in enumerate(results.methods):
        images = array_of(run, STAGE, "mean_image_e") if place == 0 else None
        title = f"Every angle, {METHOD_NAMES[method]}"
        blocks += maps_figure(run, STAGE, title, images, prefix=f"{method}/")
    tables = (_errors(results.methods), _agreement(results.methods), _angles(results))
    return Section(
        STAGE, "Derotator test, simulated", _lead(results), [*blocks, *_parts(run, results), *tables]
    )


def _lead(results: DerotatorSeriesResults) -> str:
    frames = " and ".join(f"{count} frames ({METHOD_NAMES[name]})" for name, count in results.frames.items())
    before, behind = (number(nm, ".0f", "nm") for nm in (results.truth.rotating_nm, results.truth.fixed_nm))
    return (
        f"{before} RMS with a phase bump before the derotator, {behind} behind it; "
        f"{len(results.angles_deg)} angles of {frames}."
    )


def _parts(run: RunData, results: DerotatorSeriesResults) -> list[Figure]:
    """Both parts as simulated and as found."""
    figures = []
    sources = {"simulated": "truth"} | {METHOD_NAMES[name]: name for name in results.methods}
    caption = (
        "Symmetric modes, of which only the sum of both parts is measured, are in the simulated map only."
    )
    for part, text in (("rotating", "turns with the derotator"), ("fixed", "does not turn")):
        stack = np.stack([array_of(run, STAGE, f"{source}/maps/{part}_nm") for source in sources.values()])
        drawing = wavefront_grid(f"series-{part}", list(sources), {"": stack}, common_limit_nm(stack[0]))
        figures.append(Figure(drawing, f"What {text}", caption, "half"))
    return figures


def _errors(methods: dict[str, MethodRow]) -> Table:
    rows = [
        (METHOD_NAMES[name], *(number(getattr(row.errors, key)) for key in ERROR_COLUMNS.values()))
        for name, row in methods.items()
    ]
    caption = (
        "RMS over the disc against what was simulated [nm], Noll 4–30; the last column counts the modes "
        "that were not estimated. Single angle: estimates as they come; two parts: what the split predicts."
    )
    return Table(("method", *ERROR_COLUMNS), rows, "Errors", caption)


def _agreement(methods: dict[str, MethodRow]) -> Table:
    rows = [
        (
            METHOD_NAMES[name],
            number(row.consistency.measured_nm),
            number(row.consistency.turned_back_nm),
            number(row.consistency.without_fixed_nm),
            number(row.consistency.expected_nm),
            number(row.chi2_nu, ".2f"),
            f"{row.sense}, {number(row.delta_chi2, '+.0f')}",
        )
        for name, row in methods.items()
    ]
    columns = (
        "method",
        "as measured",
        "turned back",
        "without the fixed part",
        "expected",
        "χ²/ν of the split",
        "sense, Δχ² of the other",
    )
    caption = "Mean RMS difference between two angles [nm]; expected: from the errors of the estimates."
    return Table(columns, rows, "Agreement of the angles", caption)


def _angles(results: DerotatorSeriesResults) -> Table:
    columns = [f"{METHOD_NAMES[name]} [nm]" for name in results.methods]
    values = [[number(value) for value in row.delta_nm] for row in results.methods.values()]
    angles = [f"{angle:g}°" for angle in results.angles_deg]
    caption = "Δ-WFE in Noll 2–30 against the mean wavefront of the frames used, AO residual included."
    return Table(("angle", *columns), list(zip(angles, *values, strict=True)), "Angles one by one", caption)
