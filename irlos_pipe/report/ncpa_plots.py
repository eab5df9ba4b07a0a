"""Modal coefficients as bars and in time, and the wavefront they add up to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from irlos_pipe.report.drawing import BLUE, CYCLE, FAINT, INK, ORANGE, svg
from irlos_pipe.report.images import PANEL_IN, SIGNED, panel_axes, symmetric_scale
from irlos_pipe.report.modes import label

WIDTH_IN = 4.4
BAR_IN = 0.165
MARKERS = ("o", "s", "D", "^", "v")


def coefficient_bars(
    name: str,
    nolls: Sequence[int],
    values_nm: np.ndarray,
    sigma_nm: np.ndarray,
    others_nm: Mapping[str, np.ndarray],
) -> Markup:
    """Draw one bar with its error per mode, and other methods as symbols."""
    rows = np.arange(len(nolls))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        error_look = {"ecolor": INK, "elinewidth": 0.9}
        axes.barh(rows, values_nm, 0.75, color=BLUE, xerr=np.nan_to_num(sigma_nm), error_kw=error_look)
        _draw_others(axes, rows, others_nm)
        axes.axvline(0, color=INK, linewidth=0.7)
        axes.set(yticks=rows, yticklabels=[label(noll) for noll in nolls], ylim=(len(nolls) - 0.4, -0.6))
        axes.set_xlabel("coefficient [nm RMS]")
        axes.grid(axis="y", visible=False)

    return svg(name, (WIDTH_IN, 0.7 + BAR_IN * len(nolls)), draw)


def _draw_others(axes: Axes, rows: np.ndarray, others_nm: Mapping[str, np.ndarray]) -> None:
    for place, (name, values_nm) in enumerate(others_nm.items()):
        colour, marker = CYCLE[1 + place % (len(CYCLE) - 1)], MARKERS[place % len(MARKERS)]
        axes.plot(values_nm, rows, marker, color=colour, markersize=3.5, label=name)
    if others_nm:
        axes.legend(loc="lower right")


def coefficients_in_time(
    name: str, nolls: Sequence[int], frames_nm: np.ndarray, mean_nm: np.ndarray
) -> Markup:
    """Draw the coefficients of every frame, one row per mode, with the adopted value.

    Parameters
    ----------
    frames_nm : ndarray, (frames, modes)
    mean_nm : ndarray, (modes,)
    """

    def draw(figure: Figure) -> None:
        stack = figure.subplots(len(nolls), sharex=True, squeeze=False)[:, 0]
        for axes, noll, values, mean in zip(stack, nolls, frames_nm.T, mean_nm, strict=True):
            axes.plot(values, ".-", color=BLUE, markersize=2, linewidth=0.5)
            axes.axhline(mean, color=ORANGE, linewidth=1.2)
            axes.set_title(f"{label(noll)} [nm]", loc="left", pad=2)
            axes.locator_params(axis="y", nbins=4)
        stack[-1].set_xlabel("used frame")

    return svg(name, (WIDTH_IN, 0.5 + 0.85 * len(nolls)), draw)


def wavefront_map(name: str, opd_nm: np.ndarray, limit_nm: float) -> Markup:
    """Draw a wavefront over the pupil, which NaN outside it show.

    Parameters
    ----------
    limit_nm : float
        End of the colour scale, the same for maps to be compared.
    """

    def draw(figure: Figure) -> None:
        axes, bar = panel_axes(figure)
        shown = axes.imshow(
            opd_nm,
            norm=symmetric_scale(limit_nm),
            cmap=SIGNED,
            origin="lower",
            interpolation="none",
            extent=(-1, 1, -1, 1),
        )
        axes.set_facecolor(FAINT)
        axes.set(xlabel="x [pupil radii]", ylabel="y [pupil radii]", xticks=(-1, 0, 1), yticks=(-1, 0, 1))
        figure.colorbar(shown, cax=bar, label="OPD [nm]", extend="both")

    return svg(name, PANEL_IN, draw)
