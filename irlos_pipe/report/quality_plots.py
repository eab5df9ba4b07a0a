"""Curves of image quality that stages hand over: OTF cuts, encircled energy, power of what is left."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import NullFormatter

from irlos_pipe.report.content import Figure
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE, svg
from irlos_pipe.report.run_data import RunData

SIZE_IN = (3.9, 2.95)
BROAD = {"linewidth": 4.0, "alpha": 0.35}  # what is measured, under the curves of models
OTF_CAPTION = (
    "Modulus of the OTF along x (solid) and y (dashed), pixels included; 1 at zero frequency. Nothing can be "
    "transferred beyond D/λ, the dotted line."
)


class Look(NamedTuple):
    """How a curve is drawn."""

    label: str
    colour: str


def _width(look: Look) -> dict[str, Any]:
    return BROAD if look.label == MEASURED else {}


MEASURED = "measured"
PREDICTED = {
    "perfect": Look("no aberration", GREEN),
    "before": Look("before", ORANGE),
    "after": Look("after", BLUE),
}
DIAGNOSED = {
    "measured": Look(MEASURED, INK),
    "before": Look("before", ORANGE),
    "after": Look("after", BLUE),
}


def otf_figures(run: RunData, stage: str, name: str, looks: Mapping[str, Look]) -> list[Figure]:
    """Return the cuts through the OTF, if the product of a stage has them.

    Parameters
    ----------
    run : RunData
    stage, name : str
        `name` is unique in the page.
    looks : mapping of str to Look
        By the end of the names of the arrays.
    """
    curves = [
        (run.array(stage, f"otf_{letter}_frequency"), run.array(stage, f"otf_{letter}_{key}"), style, look)
        for key, look in looks.items()
        for letter, style in (("x", "-"), ("y", "--"))
    ]
    known = [
        (at, value, style, look) for at, value, style, look in curves if at is not None and value is not None
    ]
    if not known:
        return []

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for at, value, style, look in known:
            label = look.label if style == "-" else None
            axes.plot(at, value, style, color=look.colour, label=label, **_width(look))
        axes.axvline(1.0, color=INK, linestyle=":", linewidth=0.8)
        axes.set(xlabel="spatial frequency [D/λ]", ylabel="|OTF|", ylim=(0, 1.02))
        axes.set_xlim(0, 1.15)
        axes.legend()

    return [Figure(svg(name, SIZE_IN, draw), "OTF cuts", OTF_CAPTION, "third")]


def energy_figures(
    run: RunData,
    stage: str,
    name: str,
    looks: Mapping[str, Look],
    caption: str,
    resolution_mas: float = float("nan"),
) -> list[Figure]:
    """Return the encircled energy, if the product of `stage` has it.

    Parameters
    ----------
    run : RunData
    stage, name : str
        `name` is unique in the page.
    looks : mapping of str to Look
    caption : str
        What the light is a part of.
    resolution_mas : float
        λ/D, to be marked; NaN leaves it out.
    """
    radius = run.array(stage, "encircled_radius_mas")
    found = {key: run.array(stage, f"encircled_{key}") for key in looks}
    curves = {key: values for key, values in found.items() if values is not None}
    if radius is None or not curves:
        return []

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for key, values in curves.items():
            look = looks[key]
            axes.plot(radius, 100 * values, color=look.colour, label=look.label, **_width(look))
        if np.isfinite(resolution_mas):
            axes.axvline(resolution_mas, color=INK, linestyle=":", linewidth=0.8, label="λ/D")
        axes.set(xlabel="radius [mas]", ylabel="encircled energy [%]", ylim=(0, 101))
        axes.set_xlim(left=0)
        axes.legend(loc="lower right")

    return [Figure(svg(name, SIZE_IN, draw), "Encircled energy", caption, "third")]


def power_figures(run: RunData, stage: str, name: str, looks: Mapping[str, Look]) -> list[Figure]:
    """Return the power spectrum of the residual, if the product of a stage has it.

    Parameters
    ----------
    run : RunData
    stage, name : str
        `name` is unique in the page.
    looks : mapping of str to Look
        By the end of the names of the arrays.
    """
    at = run.array(stage, "left_frequency")
    found = {key: run.array(stage, f"left_power{key}") for key in looks}
    curves = {key: values for key, values in found.items() if values is not None}
    if at is None or not curves:
        return []
    drawing = power_plot(name, at, {looks[key]: values for key, values in curves.items()})
    caption = (
        "Azimuthal mean over the residual in σ: white noise gives 1. Light has no structure finer than λ/D, "
        "which is beyond the dotted line: what is left there comes from the pixels. Fitted parameters take "
        "power out, and noise that neighbouring pixels share moves it to low frequencies."
    )
    return [Figure(drawing, "Power spectrum of the residual", caption, "third")]


def power_plot(name: str, at: np.ndarray, curves: Mapping[Look, np.ndarray]) -> Markup:
    """Draw power spectra.

    Parameters
    ----------
    name : str
        Unique in the page.
    at : ndarray, (points,)
        Frequency [D/λ].
    curves : mapping of Look to ndarray, (points,)
    """

    def draw(figure: Canvas) -> None:
        axes: Axes = figure.subplots()
        for look, values in curves.items():
            axes.plot(at, np.where(values > 0, values, np.nan), ".-", color=look.colour, label=look.label)
        axes.axhline(1.0, color=INK, linestyle="--", linewidth=0.9, label="white noise")
        axes.axvline(1.0, color=INK, linestyle=":", linewidth=0.8)
        axes.set(xlabel="spatial frequency [D/λ]", ylabel="power [σ²]")
        if any(np.any(values > 0) for values in curves.values()):
            axes.set_yscale("log")
            axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_xlim(left=0)
        axes.legend()

    return svg(name, SIZE_IN, draw)
