"""Radial profiles on a logarithmic axis."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from irlos_pipe.report.drawing import log_y, svg

SIZE_IN = (4.4, 3.2)


def profile_plot(
    name: str,
    curves: Mapping[str, tuple[np.ndarray, np.ndarray, str, str]],
    units: tuple[str, str],
    size_in: tuple[float, float] = SIZE_IN,
) -> Markup:
    """Draw profiles; values that are not positive leave gaps.

    Parameters
    ----------
    name : str
        Unique in the page.
    curves : mapping
        By label: radius, values, colour and line style.
    units : tuple of str
        Unit of the radius, and label of the axis of the values.
    size_in : tuple of float
        Width and height [inch].
    """

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for label, (radius, values, colour, style) in curves.items():
            axes.plot(radius, np.where(values > 0, values, np.nan), style, color=colour, label=label)
        axes.set(xlabel=f"radius [{units[0]}]", ylabel=units[1])
        axes.set_xlim(left=0)
        log_y(axes, *(values for _, values, *_ in curves.values()))
        axes.legend()

    return svg(name, size_in, draw)
