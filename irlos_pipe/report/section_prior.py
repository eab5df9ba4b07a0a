"""Section on the elongation prior."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.report.content import Figure, Section
from irlos_pipe.report.drawing import BLUE, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, number

STAGE = "prior"


def prior_section(run: RunData) -> Section:
    """Build the section."""
    ratio, introduced = run.array(STAGE, "ratio"), run.array(STAGE, "introduced_nm")
    blocks = [] if ratio is None or introduced is None else [
        Figure(_plot(ratio, introduced, _law(run.results(STAGE))), "Axis ratio against introduced defocus",
               "The elongation sees the introduced defocus and that of the NCPAs together: points beside the law "
               "show the latter.")]
    return Section(STAGE, "Elongation prior", _lead(run), blocks)


def _lead(run: RunData) -> str:
    results = run.results(STAGE)
    low, high = results.get("valid_nm") or (None, None)
    scatter = number(results.get("law_residual_nm"), ".0f", "nm")
    return (f"defocus = {number(results.get('A'), '.0f')} nm · (σ₁/σ₂ − 1) {number(results.get('B'), '+.0f')} nm, "
            f"from {number(low, '.0f')} to {number(high, '.0f', 'nm')}"
            + (f"; the law departs {scatter} RMS from the model." if scatter != MISSING else "."))


def _law(results: dict) -> tuple[np.ndarray, np.ndarray] | None:
    """Defocus and ratio along the law, over its range."""
    if not results.get("A") or results.get("B") is None or None in (results.get("valid_nm") or [None]):
        return None
    defocus = np.array(results["valid_nm"], dtype=float)
    return defocus, 1 + (defocus - results["B"]) / results["A"]


def _plot(ratio: np.ndarray, introduced: np.ndarray, law: tuple[np.ndarray, np.ndarray] | None) -> Markup:
    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.plot(introduced, ratio, "o", color=BLUE, markersize=3, label="frames")
        if law is not None:
            axes.plot(*law, color=ORANGE, label="law, over its range")
        axes.set(xlabel="introduced defocus [nm RMS]", ylabel="axis ratio σ₁/σ₂")
        axes.legend()

    return svg("prior-law", (4.4, 3.0), draw)
