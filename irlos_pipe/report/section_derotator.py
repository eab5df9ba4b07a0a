"""Section on the derotator test: maps at every angle, what turns and what does not."""

from __future__ import annotations

from typing import Any

import numpy as np

from irlos_pipe.report.content import Section, Stack
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.split_blocks import (
    angle_titles,
    angles_table,
    coefficients_table,
    consistency_table,
    maps_figure,
    parts_figure,
    parts_table,
)
from irlos_pipe.report.text import number, plural

STAGE = "derotator"


def derotator_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    names = [cube["name"] for cube in results.get("cubes", [])]
    angles = angles_table(names, angle_titles(run, STAGE), results)
    blocks = maps_figure(run, STAGE, "Wavefront at every angle", _images(run, names))
    if results.get("parts"):
        blocks += [
            *parts_figure(run, STAGE, results["parts"]),
            Stack([parts_table(results), consistency_table(results)]),
            Stack([angles, coefficients_table(results["parts"])]),
        ]
    else:
        blocks.append(Stack([angles]))
    return Section(STAGE, "Derotator test", _lead(results), blocks)


def _images(run: RunData, names: list[str]) -> np.ndarray | None:
    images = [run.array("calibrate", f"cubes/{name}/mean_image_e") for name in names]
    alike = len({None if image is None else image.shape for image in images}) == 1
    return np.stack(images) if images and alike and images[0] is not None else None


def _lead(results: dict[str, Any]) -> str:
    if not results.get("parts"):
        return (
            f"Nothing split: {results.get('reason')}. What turns with the derotator shows only in recordings "
            "of two or more angles."
        )
    parts, cubes = results["parts"], plural(len(results["cubes"]), "cube")
    rotating, fixed = (number(parts[name]["rms_nm"], ".0f", "nm") for name in ("rotating", "fixed"))
    return f"{rotating} RMS turn with the derotator, {fixed} do not: {cubes}, each calibrated by itself."
