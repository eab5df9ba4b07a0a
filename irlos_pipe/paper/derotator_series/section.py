"""Section on the simulated derotator test: maps per angle, parts against the truth, by two methods."""

from __future__ import annotations

from typing import Any

import numpy as np

from irlos_pipe.report.content import Figure, Section, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_derotator import angle_titles, maps_figure
from irlos_pipe.report.text import number
from irlos_pipe.report.wavefront_plots import common_limit_nm, wavefront_grid

STAGE = "derotator_series"
METHODS = {"long_exposure": "this pipeline's default", "dip_global": "DIP global"}
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
    results = run.results(STAGE)
    methods = results.get("methods", {})
    blocks: list[Figure | Table] = []
    for place, method in enumerate(methods):
        images = run.array(STAGE, "mean_image_e") if place == 0 else None
        title = f"Every angle, {METHODS.get(method, method)}"
        blocks += maps_figure(run, STAGE, title, images, prefix=f"{method}/")
    if methods:
        blocks += [*_parts(run, results), _errors(methods), _agreement(methods), _angles(run, methods)]
    return Section(STAGE, "Derotator test, simulated", _lead(results), blocks)


def _lead(results: dict[str, Any]) -> str:
    truth, frames = results.get("truth", {}), results.get("frames", {})
    told = " and ".join(f"{count} frames ({METHODS.get(name, name)})" for name, count in frames.items())
    before, behind = (number(truth.get(f"{part}_nm"), ".0f", "nm") for part in ("rotating", "fixed"))
    return (
        f"{before} RMS with a phase bump before the derotator, {behind} behind it; "
        f"{len(results.get('angles_deg', []))} angles of {told}."
    )


def _parts(run: RunData, results: dict[str, Any]) -> list[Figure]:
    """Both parts as simulated and as found."""
    figures = []
    for part, text in (("rotating", "turns with the derotator"), ("fixed", "does not turn")):
        sources = {"simulated": "truth"} | {METHODS.get(name, name): name for name in results["methods"]}
        maps = [run.array(STAGE, f"{source}/maps/{part}_nm") for source in sources.values()]
        if any(one is None for one in maps):
            return []
        stack = np.stack(maps)
        drawing = wavefront_grid(f"series-{part}", list(sources), {"": stack}, common_limit_nm(stack[0]))
        caption = (
            "Symmetric modes, of which only the sum of both parts is measured, are in the simulated map only."
        )
        figures.append(Figure(drawing, f"What {text}", caption, "half"))
    return figures


def _errors(methods: dict[str, Any]) -> Table:
    rows = [
        (METHODS.get(name, name), *(number(found["errors"].get(key)) for key in ERROR_COLUMNS.values()))
        for name, found in methods.items()
    ]
    caption = (
        "RMS over the disc against what was simulated [nm], Noll 4–30; the last column counts the modes "
        "that were not estimated. Single angle: estimates as they come; two parts: what the split predicts."
    )
    return Table(("method", *ERROR_COLUMNS), rows, "Errors", caption)


def _agreement(methods: dict[str, Any]) -> Table:
    keys = ("measured_nm", "turned_back_nm", "without_fixed_nm", "expected_nm")
    rows = [
        (
            METHODS.get(name, name),
            *(number(found["consistency"].get(key)) for key in keys),
            number(found.get("chi2_nu"), ".2f"),
            f"{found.get('sense')}, {number(found.get('delta_chi2'), '+.0f')}",
        )
        for name, found in methods.items()
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


def _angles(run: RunData, methods: dict[str, Any]) -> Table:
    angles = angle_titles(run, STAGE, f"{next(iter(methods))}/")
    columns = [f"{METHODS.get(name, name)} [nm]" for name in methods]
    values = [[number(value) for value in found["delta_nm"]] for found in methods.values()]
    caption = "Δ-WFE in Noll 2–30 against the mean wavefront of the frames used, AO residual included."
    return Table(("angle", *columns), list(zip(angles, *values, strict=True)), "Angles one by one", caption)
