"""How complete a diagnosis is: its grade in words, what is left, and the picture of that."""

from __future__ import annotations

import numpy as np

from irlos_pipe.frames.detector import star_position
from irlos_pipe.report.content import Figure, Text
from irlos_pipe.report.images import SIGNED, Ring, image_panel, symmetric_scale
from irlos_pipe.report.run_data import RunData
from irlos_pipe.stages.diagnose.results import DiagnoseResults, RestRow

STAGE = DiagnoseResults.stage
PERCENTILE = 99.5  # of what is left, for its scale
IN_WORDS = {
    "none": "nothing significant is missing",
    "complete": "what was found explains all that was missing",
    "partial": "what was found is missing, and something else is missing as well",
    "resembles": "the best name explains much, but leaves a part of its own signal where it acts: it stands "
    "in for something that the catalogue lacks",
    "unknown": "something is missing that nothing in the catalogue explains",
}
CAPTION = (
    "Measured − predicted after, on a scale of its own. The ring is as large as the strongest part and "
    "stands about it."
)


def grade_texts(results: DiagnoseResults) -> list[Text]:
    """Grade of the verdict in words; nothing for a ramp, which has none."""
    words = IN_WORDS.get(results.grade)
    return [Text(f"{results.verdict}, {results.grade}: {words}.", "Grade")] if words else []


def rest_blocks(run: RunData, results: DiagnoseResults) -> list[Figure | Text]:
    """What the final model misses, in words and as an image."""
    if results.rest is None:
        return []
    return [Text(f"{results.rest.text}.", "What is left"), *_picture(run, results.rest)]


def _picture(run: RunData, rest: RestRow) -> list[Figure]:
    measured, after = (run.array(STAGE, name) for name in ("measured_e", "after_e"))
    if measured is None or after is None:
        return []
    left, mas = measured - after, run.pixel_scale_mas(STAGE)
    scale = symmetric_scale(float(np.nanpercentile(np.abs(left), PERCENTILE)) or 1.0)
    ring = _ring(rest, after, mas) if mas else None
    panel = image_panel("dia-rest", left, scale, mas, "e⁻", SIGNED, ring=ring)
    return [Figure(panel, "Residual after, enlarged", CAPTION, "third")]


def _ring(rest: RestRow, model_e: np.ndarray, pixel_scale_mas: float) -> Ring:
    """The strongest part of what is left, from the centre of the window."""
    row, column = star_position(np.nan_to_num(model_e))
    rows, columns = model_e.shape
    return Ring(
        (column - (columns - 1) / 2) * pixel_scale_mas + rest.where.x_mas,
        (row - (rows - 1) / 2) * pixel_scale_mas + rest.where.y_mas,
        rest.where.extent_mas,
    )
