"""Section on LIFT: the ramp, what the parts of the model buy, images per offset."""

from __future__ import annotations

from typing import Any

import numpy as np

from irlos_pipe.estimate.ramp import travel_direction
from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.ramp_plots import RampPoints, image_strip, ramp_plot, residual_limit
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural, with_error

STAGE = "lift"
MOST_OFFSETS = 12
FEW_OFFSETS = 3
CAPTION = (
    "Frames of one offset stand side by side in order of time; the colour tells from which side "
    "the offset was reached."
)
VARIANT_COLUMNS = (
    "model",
    "slope",
    "offset [nm]",
    "error [nm RMS]",
    "about the line [nm RMS]",
    "saw-tooth [nm]",
)


def lift_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    blocks = [*_ramp(results), Stack([*_variants(results), *_offsets(results)]), *_strip(run)]
    return Section(STAGE, "Defocus ramp (LIFT)", _lead(results), blocks)


def _lead(results: dict[str, Any]) -> str:
    modes = ", ".join(map(str, results.get("modes", [])))
    ncpas = "added to the diversity" if results.get("calibrated") else "left out"
    return f"Noll {modes} of {plural(len(results.get('points', [])), 'frame')}; NCPAs {ncpas}."


def _ramp(results: dict[str, Any]) -> list[Figure]:
    points = [point for point in results.get("points", []) if point.get("introduced_nm") is not None]
    introduced = np.array([point["introduced_nm"] for point in points], dtype=float)
    if not points:
        return []
    defocus, sigma = (
        np.array([point.get(key) for point in points], dtype=float) for key in ("defocus_nm", "sigma_nm")
    )
    converged = np.array([bool(point.get("converged", True)) for point in points])
    missing = int(np.sum(~np.isfinite(defocus)))
    lost = f" {plural(missing, 'frame')} without estimate." if missing else ""
    caption = f"{CAPTION}{lost}"
    direction = travel_direction(introduced).astype(int)
    return [Figure(ramp_plot(RampPoints(introduced, defocus, sigma, direction, converged)), "Ramp", caption)]


def _variants(results: dict[str, Any]) -> list[Table]:
    summaries = {"as configured": results.get("summary", {})} | (results.get("compare") or {})
    rows = [_variant_row(name, one) for name, one in summaries.items()]
    title = "What the parts of the model buy" if len(rows) > 1 else "Ramp in numbers"
    return [
        Table(
            VARIANT_COLUMNS,
            rows,
            title,
            "Saw-tooth: offsets reached upwards minus those reached downwards, fitted with the line.",
        )
    ]


def _variant_row(name: str, one: dict[str, Any]) -> tuple[str, ...]:
    slope = with_error(one.get("slope"), one.get("slope_sigma"), ".4f")
    return (
        name,
        slope,
        number(one.get("offset_nm"), "+.1f"),
        number(one.get("rms_nm")),
        number(one.get("residual_rms_nm")),
        with_error(one.get("saw_tooth_nm"), one.get("saw_tooth_sigma_nm"), "+.1f"),
    )


def _strip(run: RunData) -> list[Figure]:
    offsets, measured, model = (
        run.array(STAGE, name) for name in ("offsets_nm", "measured_per_offset_e", "model_per_offset_e")
    )
    if offsets is None or measured is None or model is None or len(offsets) == 0:
        return []
    limit = residual_limit(measured, model)
    caption = (
        f"Asinh scale to the peak of each offset; residual ±{limit:.1%} of the model's peak "
        "(red: brighter than the model, blue: fainter)."
    )
    width = "full" if len(offsets) > FEW_OFFSETS else "half"
    return [Figure(image_strip(offsets, measured, model, limit), "Mean image per offset", caption, width)]


def _offsets(results: dict[str, Any]) -> list[Table]:
    rows = [
        (
            number(one.get("introduced_nm"), "+.1f"),
            number(one.get("median_nm"), "+.1f"),
            number(one.get("scatter_nm")),
        )
        for one in results.get("offsets", [])
    ]
    columns = ("introduced [nm]", "median [nm]", "1σ over frames [nm]")
    return [Table(columns, rows, "Median per offset", folded=len(rows) > MOST_OFFSETS)] if rows else []
