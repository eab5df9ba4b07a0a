"""A ramp as its diagnosis sees it: estimates against what was commanded and against what was found."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.report.content import Figure
from irlos_pipe.report.drawing import BLUE, INK, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.stages.diagnose.results import DiagnoseResults

STAGE = DiagnoseResults.stage
SIZE_IN = (4.8, 3.6)


def ramp_figures(run: RunData) -> list[Figure]:
    """Return the course of the ramp, if the diagnosis was of one."""
    found = [run.array(STAGE, f"{name}_nm") for name in ("commanded", "corrected", "estimated")]
    commanded, corrected, estimated = found
    if commanded is None or corrected is None or estimated is None:
        return []
    caption = (
        "Frames in order of time. Below: what the estimates miss of the commanded defocus, and of that with "
        "the errors of the stage that were found."
    )
    return [Figure(course_plot("dia-ramp", commanded, corrected, estimated), "The ramp", caption)]


def course_plot(
    name: str, commanded_nm: np.ndarray, corrected_nm: np.ndarray, estimated_nm: np.ndarray
) -> Markup:
    """Draw a ramp over its frames.

    Parameters
    ----------
    name : str
        Unique in the page.
    commanded_nm, corrected_nm, estimated_nm : ndarray, (frames,)
        Defocus as commanded, with what was found, and as estimated.
    """
    differs = bool(np.any(np.abs(corrected_nm - commanded_nm) > 1e-6))

    def draw(figure: Canvas) -> None:
        top, bottom = figure.subplots(2, sharex=True, height_ratios=(3, 2))
        frames = np.arange(len(commanded_nm))
        top.step(frames, commanded_nm, where="mid", color=INK, linewidth=0.9, label="commanded")
        top.plot(frames, estimated_nm, ".", color=BLUE, label="estimated")
        bottom.axhline(0, color=INK, linewidth=0.9)
        bottom.plot(frames, estimated_nm - commanded_nm, ".", color=ORANGE, label="against commanded")
        if differs:
            bottom.plot(frames, estimated_nm - corrected_nm, ".", color=BLUE, label="against what was found")
        top.set(ylabel="defocus [nm RMS]")
        bottom.set(xlabel="frame", ylabel="difference [nm]")
        figure.legend(loc="outside upper center", ncols=2)

    return svg(name, SIZE_IN, draw)
