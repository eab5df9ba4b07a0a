"""Drawings of a focus ramp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from irlos_pipe.report.drawing import BLUE, INK, ORANGE, PURPLE, svg
from irlos_pipe.report.images import BRIGHTNESS, SIGNED, brightness_scale, symmetric_scale
from irlos_pipe.report.text import number

# Direction of travel: label, marker, colour.
TRAVEL = {
    1: ("defocus was raised", "^", ORANGE),
    -1: ("defocus was lowered", "v", BLUE),
    0: ("first offset", "o", PURPLE),
}
SPREAD = 0.3  # of the step between offsets
RESIDUAL_PERCENTILE = 99.8
STRIP_COLUMNS = 9
CELL_IN = 1.5


@dataclass(frozen=True)
class RampPoints:
    """Frames of a ramp in order of time; NaN where an estimate is missing.

    Attributes
    ----------
    direction : ndarray of int, (frames,)
        +1, -1, or 0 before the first move.
    converged : ndarray of bool, (frames,)
    """

    introduced_nm: np.ndarray
    defocus_nm: np.ndarray
    sigma_nm: np.ndarray
    direction: np.ndarray
    converged: np.ndarray


def ramp_plot(points: RampPoints) -> Markup:
    """Draw estimated against introduced defocus with the 1:1 line, and their difference below."""

    def draw(figure: Figure) -> None:
        top, bottom = figure.subplots(2, sharex=True, height_ratios=(3, 2))
        x = _spread_out(points.introduced_nm)
        ends = [np.min(points.introduced_nm), np.max(points.introduced_nm)]
        top.plot(ends, ends, color=INK, linewidth=0.9, label="1:1")
        bottom.axhline(0, color=INK, linewidth=0.9)
        _markers(top, x, points.defocus_nm, points)
        _markers(bottom, x, points.defocus_nm - points.introduced_nm, points)
        top.set(ylabel="estimated defocus [nm RMS]")
        top.legend()
        bottom.set(xlabel="introduced defocus [nm RMS]", ylabel="estimated −\nintroduced [nm]")

    return svg("ramp", (4.8, 4.8), draw)


def image_strip(offsets_nm: np.ndarray, measured: np.ndarray, model: np.ndarray, limit: float) -> Markup:
    """Draw measured, model and residual of some offsets, each column on its own scale.

    Parameters
    ----------
    measured, model : ndarray, (offsets, rows, columns)
    limit : float
        End of the residual's colour scale, in parts of the model's peak.
    """
    chosen = np.unique(np.linspace(0, len(offsets_nm) - 1, min(STRIP_COLUMNS, len(offsets_nm))).astype(int))

    def draw(figure: Figure) -> None:
        grid = figure.subplots(3, len(chosen), squeeze=False)
        for column, index in zip(grid.T, chosen, strict=True):
            _draw_column(column, measured[index], model[index], limit)
            column[0].set_title(number(offsets_nm[index], "+.0f", "nm"))
        for axes, name in zip(grid[:, 0], ("measured", "model", "residual"), strict=True):
            axes.set_ylabel(name)

    return svg("ramp-images", (0.3 + CELL_IN * len(chosen), 0.3 + 3 * CELL_IN), draw)


def residual_limit(measured: np.ndarray, model: np.ndarray) -> float:
    """End of the colour scale that suits the residuals of all offsets, in parts of the model's peak."""
    values = np.abs([_relative_residual(*pair) for pair in zip(measured, model, strict=True)])
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, RESIDUAL_PERCENTILE)) if finite.any() else 1.0


def _relative_residual(measured: np.ndarray, model: np.ndarray) -> np.ndarray:
    peak = np.max(model, initial=0.0, where=np.isfinite(model))
    return (measured - model) / (peak or 1.0)


def _draw_column(column: np.ndarray, measured: np.ndarray, model: np.ndarray, limit: float) -> None:
    scale = brightness_scale(measured, model)
    residual = _relative_residual(measured, model)
    for axes, image in zip(column[:2], (measured, model), strict=True):
        axes.imshow(image, norm=scale, cmap=BRIGHTNESS, origin="lower", interpolation="none")
    column[2].imshow(residual, norm=symmetric_scale(limit), cmap=SIGNED, origin="lower", interpolation="none")
    for axes in column:
        axes.grid(False)
        axes.set(xticks=[], yticks=[])


def _spread_out(introduced_nm: np.ndarray) -> np.ndarray:
    """Frames of one offset side by side, in order of time."""
    offsets, group, count = np.unique(introduced_nm, return_inverse=True, return_counts=True)
    step = np.min(np.diff(offsets)) if len(offsets) > 1 else 1.0
    place = np.array([np.sum(group[:i] == group[i]) for i in range(len(group))])
    return introduced_nm + SPREAD * step * ((place + 0.5) / count[group] - 0.5)


def _markers(axes: Axes, x: np.ndarray, y: np.ndarray, points: RampPoints) -> None:
    for direction, (label, marker, colour) in TRAVEL.items():
        chosen = (points.direction == direction) & np.isfinite(y)
        if chosen.any():
            axes.errorbar(
                x[chosen],
                y[chosen],
                np.nan_to_num(points.sigma_nm[chosen]),
                fmt=marker,
                color=colour,
                markersize=4,
                linewidth=0.8,
                label=label,
            )
    failed = ~points.converged & np.isfinite(y)
    if failed.any():
        axes.plot(x[failed], y[failed], "x", color=INK, markersize=7, label="not converged")
