"""The picture of what a diagnosis leaves."""

from __future__ import annotations

import numpy as np

from irlos_pipe.frames.detector import star_position
from irlos_pipe.report.content import Figure
from irlos_pipe.report.image_views import in_sigma
from irlos_pipe.report.images import SIGNED, Ring, image_panel, symmetric_scale
from irlos_pipe.report.run_data import RunData
from irlos_pipe.stages.diagnose.results import DiagnoseResults, RestRow

STAGE = DiagnoseResults.stage
PERCENTILE, LEAST_SIGMA = 99.8, 3.0  # of what is left, for its scale
CAPTION = (
    "Measured − predicted after, on a scale of its own. The ring is as large as the strongest part and "
    "stands about it."
)


def rest_blocks(run: RunData, results: DiagnoseResults) -> list[Figure]:
    """What the final model misses as an image; the verdict has the words."""
    if results.rest is None:
        return []
    return _picture(run, results.rest)


def _picture(run: RunData, rest: RestRow) -> list[Figure]:
    measured, after = (run.array(STAGE, name) for name in ("measured_e", "after_e"))
    if measured is None or after is None:
        return []
    sigma, mas = run.error_of(STAGE, "measured_e"), run.pixel_scale_mas(STAGE)
    left = (measured - after) * (np.nan if sigma is None else in_sigma(sigma))
    largest = np.abs(left[np.isfinite(left)])
    scale = symmetric_scale(
        max(LEAST_SIGMA, float(np.percentile(largest, PERCENTILE)) if largest.size else 0.0)
    )
    ring = _ring(rest, after, mas) if mas else None
    panel = image_panel("dia-rest", left, scale, mas, "σ", SIGNED, ring=ring)
    return [Figure(panel, "What is left", CAPTION, "third")]


def _ring(rest: RestRow, model_e: np.ndarray, pixel_scale_mas: float) -> Ring:
    """The strongest part of what is left, from the centre of the window."""
    row, column = star_position(np.nan_to_num(model_e))
    rows, columns = model_e.shape
    return Ring(
        (column - (columns - 1) / 2) * pixel_scale_mas + rest.where.x_mas,
        (row - (rows - 1) / 2) * pixel_scale_mas + rest.where.y_mas,
        rest.where.extent_mas,
    )
