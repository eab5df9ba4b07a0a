"""How well models fit: quantiles of the residual against those of noise, and χ² frame by frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy
from matplotlib.figure import Figure as Canvas

from irlos_pipe.report.content import Figure
from irlos_pipe.report.drawing import BLUE, FAINT, INK, ORANGE, svg
from irlos_pipe.report.quality_plots import SIZE_IN, Look
from irlos_pipe.report.text import is_known, number

FEWEST = 20  # values that are worth a plot of quantiles
DRAWN = 300  # points in the middle; the ends are all drawn
ENDS = 25
BAND = 0.95
QUANTILES = (
    "Residuals of all pixels in σ, in order of size, against those that Gaussian noise of 1 σ would have, on "
    "average (the line) and in 95 % of all images (grey): flatter is less than the noise that was told, "
    "steeper is more, and ends that bend away are single pixels or structure."
)
SERIES = (
    "χ²/ν of every frame in order of time: frames that stand out were recorded in other conditions, or their "
    "fit stopped elsewhere."
)


def normal_quantiles(count: int) -> np.ndarray:
    """Return where the values of so many normal deviates are expected in order of size, by Blom's rule.

    Parameters
    ----------
    count : int

    Returns
    -------
    ndarray, (count,)
        To a few per mille of σ of the mean order statistics (Blom 1958).
    """
    return scipy.special.ndtri((np.arange(1, count + 1) - 0.375) / (count + 0.25))


def quantile_band(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return between what values each of so many normal deviates in order of size lies in 95 % of all cases.

    The i-th of n uniform deviates in order of size has the distribution Beta(i, n + 1 − i).

    Parameters
    ----------
    count : int
    """
    rank = np.arange(1, count + 1)
    low, high = (
        scipy.special.ndtri(scipy.special.betaincinv(rank, count + 1 - rank, part))
        for part in ((1 - BAND) / 2, (1 + BAND) / 2)
    )
    return low, high


def quantile_figures(name: str, residuals: Mapping[Look, np.ndarray]) -> list[Figure]:
    """Return quantiles of residuals against those of noise; nothing where too few values are known.

    Parameters
    ----------
    name : str
        Unique in the page.
    residuals : mapping of Look to ndarray
        In σ, of any shape; NaN where a pixel does not count.
    """
    found = {look: np.sort(values[np.isfinite(values)]) for look, values in residuals.items()}
    known = {look: values for look, values in found.items() if len(values) >= FEWEST}
    if not known:
        return []
    count = max(map(len, known.values()))

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        at = normal_quantiles(count)
        chosen = _drawn(count)
        low, high = quantile_band(count)
        axes.fill_between(at[chosen], low[chosen], high[chosen], color=FAINT, linewidth=0)
        axes.plot(at[[0, -1]], at[[0, -1]], color=INK, linewidth=0.9, label="noise of 1 σ")
        for look, values in known.items():
            own = _drawn(len(values))
            axes.plot(
                normal_quantiles(len(values))[own], values[own], ".", color=look.colour, label=look.label
            )
        axes.set(xlabel="expected of noise [σ]", ylabel="residual [σ]")
        axes.legend()

    return [Figure(svg(name, SIZE_IN, draw), "Quantiles of the residual", QUANTILES, "third")]


def chi2_figures(name: str, chi2_nu: np.ndarray, nominal: float, limit: float) -> list[Figure]:
    """Return χ²/ν frame by frame; nothing where none is known.

    Parameters
    ----------
    name : str
        Unique in the page.
    chi2_nu : ndarray, (frames,)
    nominal : float
        What a right model would give; NaN where it is not known.
    limit : float
        Median beyond which quality control fails; NaN without.
    """
    if not np.any(np.isfinite(chi2_nu)):
        return []

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.plot(np.arange(len(chi2_nu)), chi2_nu, ".", color=BLUE)
        if is_known(limit) and is_known(nominal):
            axes.axhspan(0, limit, color=FAINT, zorder=0)
        if is_known(nominal):
            axes.axhline(nominal, color=ORANGE, linestyle="--", linewidth=1.0, label="a right model")
            axes.legend()
        axes.set(xlabel="frame", ylabel="χ²/ν")
        axes.set_ylim(bottom=0)

    told = f" A right model would give {number(nominal, '.2f')} (dashed)." if is_known(nominal) else ""
    grey = (
        f" Grey: quality control asks for a median up to {number(limit, '.2f')}." if is_known(limit) else ""
    )
    return [Figure(svg(name, SIZE_IN, draw), "χ² of every frame", f"{SERIES}{told}{grey}", "third")]


def _drawn(count: int) -> np.ndarray:
    """Indices of the values that are drawn: both ends in full, the middle thinned out."""
    middle = np.linspace(0, count - 1, min(count, DRAWN)).astype(int)
    ends = np.concatenate([np.arange(min(ENDS, count)), np.arange(max(count - ENDS, 0), count)])
    return np.unique(np.concatenate([middle, ends]))
