"""Section on LIFT: the ramp, what each part of the model contributes, images per offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.estimate.ramp import travel_direction
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table, Width
from irlos_pipe.report.drawing import BLUE, INK, ORANGE, PURPLE, log_y, svg
from irlos_pipe.report.images import BRIGHTNESS, SIGNED, brightness_scale, symmetric_scale
from irlos_pipe.report.misfit_plots import chi2_figures
from irlos_pipe.report.quality_plots import SIZE_IN
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural, with_error
from irlos_pipe.stages.lift.input import own_text
from irlos_pipe.stages.lift.results import DECISIVE, LiftResults, Line, Offset, Point, Twin

STAGE = "lift"
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
MOST_OFFSETS = 12
FEW_OFFSETS = 3
CAPTION = (
    "Frames of one offset stand side by side in order of time; the colour shows from which side "
    "the offset was reached."
)
TWIN = (
    "The defocus is held at each value, and everything else fitted. Without diversity the curve would have a "
    "second minimum, as deep as the first, near the same defocus of the other sign."
)
VARIANT_COLUMNS = (
    "model",
    "slope",
    "offset [nm]",
    "error [nm RMS]",
    "about the line [nm RMS]",
    "saw-tooth [nm]",
)


def lift_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(LiftResults)
    tables = Stack([_variants(results), *_offsets(results.offsets)])
    blocks: list[Block] = [
        *_ramp(results.points),
        tables,
        *_chi2(run, results),
        *_twin(run, results.twin),
        *_strip(run),
    ]
    return Section(STAGE, "Defocus ramp (LIFT)", _lead(results), blocks)


def _lead(results: LiftResults) -> str:
    modes = ", ".join(map(str, results.modes))
    ncpas = "in the known wavefront" if results.calibrated else "left out"
    own = own_text(results.effects)
    frames = plural(len(results.points), "frame")
    return f"Noll {modes} of {frames}; NCPAs {ncpas}{f', to which {own}' if own else ''}."


def _ramp(frames: Sequence[Point]) -> list[Figure]:
    points = [point for point in frames if np.isfinite(point.introduced_nm)]
    if not points:
        return []
    introduced = np.array([point.introduced_nm for point in points])
    defocus = np.array([point.defocus_nm for point in points])
    sigma = np.array([point.sigma_nm for point in points])
    converged = np.array([point.converged for point in points])
    missing = int(np.sum(~np.isfinite(defocus)))
    lost = f" {plural(missing, 'frame')} without estimate." if missing else ""
    caption = f"{CAPTION}{lost}"
    direction = travel_direction(introduced).astype(int)
    return [Figure(ramp_plot(RampPoints(introduced, defocus, sigma, direction, converged)), "Ramp", caption)]


def _chi2(run: RunData, results: LiftResults) -> list[Figure]:
    chi2_nu = np.array([point.chi2_nu for point in results.points])
    ratio = run.products[STAGE].config.get("max_chi2_ratio") or np.nan
    return chi2_figures("ramp-chi2", chi2_nu, results.nominal_chi2_nu, ratio * results.nominal_chi2_nu)


def _twin(run: RunData, twin: Twin) -> list[Figure]:
    focus_nm, chi2_nu = run.array(STAGE, "curve_defocus_nm"), run.array(STAGE, "curve_chi2_nu")
    if focus_nm is None or chi2_nu is None or not np.isfinite(chi2_nu).any():
        return []
    caption = f"Frame {twin.frame} of {twin.name}, whose χ²/ν is the median. {TWIN} {_twin_said(twin)}"
    return [Figure(twin_plot(focus_nm, chi2_nu, twin), "Is the twin excluded?", caption, "third")]


def _twin_said(twin: Twin) -> str:
    if not np.isfinite(twin.twin_nm):
        return "There is no other minimum: the twin is excluded."
    where = f"The other minimum, at {twin.twin_nm:+.0f} nm, has Δχ² = {twin.delta_chi2:,.0f}"
    fits = where + (f", {twin.evidence:,.0f} in units of the misfit" if twin.chi2_nu > 1 else "")
    if twin.evidence >= DECISIVE:
        return f"{fits}: it is excluded."
    if twin.evidence <= -DECISIVE:
        return f"{fits}: it fits better, and the estimate of this frame is wrong."
    return f"{fits}: it is not excluded, and the sign of defocus is open."


def _variants(results: LiftResults) -> Table:
    lines = {"as configured": results.summary} | results.compare
    title = "Contribution of each part of the model" if len(lines) > 1 else "Ramp in numbers"
    caption = "Saw-tooth: offsets reached upwards minus those reached downwards, fitted with the line."
    return Table(VARIANT_COLUMNS, [_variant_row(*one) for one in lines.items()], title, caption)


def _variant_row(name: str, one: Line) -> tuple[str, ...]:
    return (
        name,
        with_error(one.slope, one.slope_sigma, ".4f"),
        number(one.offset_nm, "+.1f"),
        number(one.rms_nm),
        number(one.residual_rms_nm),
        with_error(one.saw_tooth_nm, one.saw_tooth_sigma_nm, "+.1f"),
    )


def _strip(run: RunData) -> list[Figure]:
    offsets, measured, model = (
        run.array(STAGE, name) for name in ("offsets_nm", "measured_per_offset_e", "model_per_offset_e")
    )
    if offsets is None or measured is None or model is None or len(offsets) == 0:
        return []
    limit = residual_limit(measured, model)
    caption = (
        f"Asinh scale to the peak of each offset; residual ±{limit:.1%} of the model's peak "
        "(red: brighter than the model, blue: fainter)."
    )
    width: Width = "full" if len(offsets) > FEW_OFFSETS else "half"
    return [Figure(image_strip(offsets, measured, model, limit), "Mean image per offset", caption, width)]


def _offsets(offsets: Sequence[Offset]) -> list[Table]:
    rows = [
        (number(one.introduced_nm, "+.1f"), number(one.median_nm, "+.1f"), number(one.scatter_nm))
        for one in offsets
    ]
    columns = ("introduced [nm]", "median [nm]", "1σ over frames [nm]")
    return [Table(columns, rows, "Median per offset", folded=len(rows) > MOST_OFFSETS)] if rows else []


# -- drawings ----------------------------------------------------------------------------------


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

    def draw(figure: Canvas) -> None:
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


def twin_plot(focus_nm: np.ndarray, chi2_nu: np.ndarray, twin: Twin) -> Markup:
    """Draw χ²/ν of one frame against the defocus it is held at, with the best fit and its `twin` marked."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.plot(focus_nm, chi2_nu, color=BLUE)
        log_y(axes, chi2_nu)
        axes.plot(twin.defocus_nm, twin.chi2_nu, "o", color=BLUE, label="best fit")
        if np.isfinite(twin.twin_nm):
            axes.plot(twin.twin_nm, twin.twin_chi2_nu, "s", color=ORANGE, label="twin")
        axes.set(xlabel="defocus [nm RMS]", ylabel="χ²/ν")
        axes.legend()

    return svg("ramp-twin", SIZE_IN, draw)


def image_strip(offsets_nm: np.ndarray, measured: np.ndarray, model: np.ndarray, limit: float) -> Markup:
    """Draw measured, model and residual of some offsets, each column on its own scale.

    Parameters
    ----------
    offsets_nm : ndarray, (offsets,)
    measured, model : ndarray, (offsets, rows, columns)
    limit : float
        End of the residual's colour scale, in parts of the model's peak.
    """
    chosen = np.unique(np.linspace(0, len(offsets_nm) - 1, min(STRIP_COLUMNS, len(offsets_nm))).astype(int))

    def draw(figure: Canvas) -> None:
        grid = figure.subplots(3, len(chosen), squeeze=False)
        for column, index in zip(grid.T, chosen, strict=True):
            _draw_column(column, measured[index], model[index], limit)
            column[0].set_title(number(offsets_nm[index], "+.0f", "nm"))
        for axes, name in zip(grid[:, 0], ("measured", "model", "residual"), strict=True):
            axes.set_ylabel(name)

    return svg("ramp-images", (0.3 + CELL_IN * len(chosen), 0.3 + 3 * CELL_IN), draw)


def residual_limit(measured: np.ndarray, model: np.ndarray) -> float:
    """Return the colour limit of the residual panels, as a fraction of the model's peak.

    Parameters
    ----------
    measured, model : ndarray, (offsets, rows, columns)
    """
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
