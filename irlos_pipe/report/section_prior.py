"""Section on the elongation prior."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.report.content import Block, Figure, Section
from irlos_pipe.report.drawing import BLUE, FAINT, INK, MANY, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, number
from irlos_pipe.stages.prior import PriorResults

STAGE = "prior"
SIZE_IN = (4.4, 2.9)


def prior_section(run: RunData) -> Section:
    """Build the section."""
    ratio, prior, introduced = (run.array(STAGE, name) for name in ("ratio", "defocus_nm", "introduced_nm"))
    results = run.results(PriorResults)
    blocks: list[Block] = []
    if ratio is not None and introduced is not None:
        blocks.append(
            Figure(
                _ratio_plot(ratio, introduced, _law(results)),
                "Axis ratio against introduced defocus",
                "The law is that of a star without NCPAs, over the range in which it is used (shaded). The "
                "elongation sees the NCPAs as well: their defocus moves the points sideways, their "
                "astigmatism changes the slope. The prior is where a fit starts, not what it finds.",
            )
        )
    if prior is not None and introduced is not None:
        blocks.append(
            Figure(
                _prior_plot(prior, introduced),
                "Prior against introduced defocus",
                "Defocus from the law; that of the NCPAs is in it.",
            )
        )
    return Section(STAGE, "Elongation prior", _lead(results), blocks)


def _lead(results: PriorResults) -> str:
    low, high = results.valid_nm
    scatter = number(results.law_residual_nm, ".0f", "nm")
    slope, offset = number(results.A, ".0f", "nm"), number(results.B, "+.0f", "nm")
    return (
        f"defocus = {slope} · (σ₁/σ₂ − 1) {offset}, from {number(low, '.0f')} to {number(high, '.0f', 'nm')}"
        + (f"; the law departs {scatter} RMS from the model." if scatter != MISSING else ".")
    )


def _law(results: PriorResults) -> tuple[np.ndarray, np.ndarray] | None:
    """Defocus and ratio along the law, over its range."""
    if not results.A or not np.isfinite([results.A, results.B, *results.valid_nm]).all():
        return None
    defocus = np.array(results.valid_nm)
    return defocus, 1 + (defocus - results.B) / results.A


def _ratio_plot(
    ratio: np.ndarray, introduced: np.ndarray, law: tuple[np.ndarray, np.ndarray] | None
) -> Markup:
    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        _frames(axes, introduced, ratio)
        if law is not None:
            axes.axvspan(law[0].min(), law[0].max(), color=FAINT, alpha=0.35, linewidth=0)
            axes.plot(*law, color=ORANGE, label="law without NCPAs")
        axes.set(xlabel="introduced defocus [nm RMS]", ylabel="axis ratio σ₁/σ₂")
        axes.legend()

    return svg("prior-law", SIZE_IN, draw)


def _frames(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    axes.plot(x, y, "o", color=BLUE, markersize=3, label="frames", rasterized=len(x) > MANY)


def _prior_plot(prior_nm: np.ndarray, introduced_nm: np.ndarray) -> Markup:
    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.plot(introduced_nm, introduced_nm, color=INK, linewidth=0.9, label="1:1")
        _frames(axes, introduced_nm, prior_nm)
        axes.set(xlabel="introduced defocus [nm RMS]", ylabel="prior of the defocus [nm RMS]")
        axes.legend()

    return svg("prior-defocus", SIZE_IN, draw)
