"""Strength of the modes, and what unseen frames say of their number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from irlos_pipe.report.drawing import CYCLE, INK, log_y, svg

SIZE_IN = (5.2, 3.6)
MARKERS = ("o", "s", "D", "^", "v", "P")


@dataclass(frozen=True)
class Points:
    """Standard deviations of the modes, with a law through them.

    Attributes
    ----------
    noll, std_nm : ndarray, (modes,)
    law_nm : ndarray, (modes,), optional
    sigma_nm : ndarray, (modes,), optional
    """

    noll: np.ndarray
    std_nm: np.ndarray
    law_nm: np.ndarray | None = None
    sigma_nm: np.ndarray | None = None


def strength_plot(
    name: str, points: Mapping[str, Points], lines: Mapping[str, np.ndarray] | None = None
) -> Markup:
    """Draw standard deviations against Noll index; `lines` have (2, modes), index and value."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for place, (label, one) in enumerate(points.items()):
            colour, marker = CYCLE[place % len(CYCLE)], MARKERS[place % len(MARKERS)]
            axes.errorbar(
                one.noll,
                one.std_nm,
                one.sigma_nm,
                fmt=marker,
                color=colour,
                markersize=3,
                linewidth=0.6,
                label=label,
            )
            if one.law_nm is not None:
                axes.plot(one.noll, one.law_nm, color=colour)
        for label, (noll, value_nm) in (lines or {}).items():
            axes.plot(noll, value_nm, "--", color=INK, linewidth=0.9, label=label)
        axes.set(xlabel="Noll index", ylabel="standard deviation [nm RMS]")
        log_y(axes, *(one.std_nm for one in points.values()))
        figure.legend(loc="outside upper center", ncols=2)

    return svg(name, SIZE_IN, draw)


def misfit_plot(
    name: str, numbers: Sequence[int], excess: np.ndarray, sigma: np.ndarray, recommended: int
) -> Markup:
    """Draw the misfit of unseen frames above the least one against the number of modes."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.errorbar(numbers, excess, sigma, fmt="o-", markersize=4)
        axes.axvline(recommended, color=INK, linewidth=0.8, linestyle=":")
        smallest = np.min(excess[excess > 0], initial=np.inf)
        axes.set_yscale("symlog", linthresh=smallest if np.isfinite(smallest) else 1.0)
        axes.set(xlabel="highest Noll mode estimated", ylabel="χ²/ν of unseen frames above the least")

    return svg(name, SIZE_IN, draw)


def error_plot(
    name: str, numbers: Sequence[int], curves: Mapping[str, np.ndarray], ylabel: str, mark: int | None = None
) -> Markup:
    """Draw one curve per label against the number of modes, (numbers,) each; `mark` gets a line."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for place, (label, values) in enumerate(curves.items()):
            marker = MARKERS[place % len(MARKERS)]
            axes.plot(
                numbers, values, f"{marker}-", color=CYCLE[place % len(CYCLE)], markersize=4, label=label
            )
        if mark is not None:
            axes.axvline(mark, color=INK, linewidth=0.8, linestyle=":")
        log_y(axes, *curves.values())
        axes.set(xlabel="highest Noll mode estimated", ylabel=ylabel)
        figure.legend(loc="outside upper center", ncols=2)

    return svg(name, SIZE_IN, draw)
