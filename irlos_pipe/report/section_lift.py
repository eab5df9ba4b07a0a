"""Sections on a ramp: its prior, LIFT with what each part of the model contributes, and its sensitivity."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.conventions.units import MEDIAN_OF_NORMAL
from irlos_pipe.effects.focus_stage import travel_direction
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.estimate.calibration_options import DECISIVE
from irlos_pipe.product.results import EffectValues
from irlos_pipe.report.content import Figure, Section, Stack, Table, Width, shown
from irlos_pipe.report.drawing import (
    BESIDE,
    BLUE,
    CYCLE,
    FAINT,
    GREEN,
    INK,
    MANY,
    ORANGE,
    PURPLE,
    figure,
    log_y,
    plot,
    svg,
)
from irlos_pipe.report.images import (
    BRIGHTNESS,
    PERCENTILE,
    SIGNED,
    brightness_scale,
    label_bar,
    percentile,
    symmetric_scale,
)
from irlos_pipe.report.run_data import RunData, StageData
from irlos_pipe.report.text import MISSING, effect_link, is_known, number, parameter_rows, plural, with_error
from irlos_pipe.stages.lift.stage import LiftResults, Twin, own_text
from irlos_pipe.stages.prior import PriorResults
from irlos_pipe.stages.sensitivity import CriterionRow, CurveRow, NoiseRow, SensitivityResults

# Direction of travel: label, marker, colour.
TRAVEL = {
    1: ("defocus was raised", "^", ORANGE),
    -1: ("defocus was lowered", "v", BLUE),
    0: ("first offset", "o", PURPLE),
}
SPREAD = 0.3  # part of the step between offsets over which its frames are spread
STRIP_COLUMNS = 9  # offsets in a strip of images
CELL_IN = 1.5
BEYOND_DOUBT = 10_000  # Δχ² above which its size says nothing more
MOST_OFFSETS = 12  # offsets above which their table is folded
FEW_OFFSETS = 3  # offsets up to which a figure takes half the width
RAMP = (
    "Frames of one offset stand side by side in order of time; the colour shows from which side "
    "the offset was reached."
)
TWIN = (
    "The defocus is held at each value, and everything else fitted. Without diversity the curve would have a "
    "second minimum, as deep as the first, near the same defocus of the other sign."
)
SERIES = (
    "χ²/ν of every frame in order of time: frames that stand out were recorded in other conditions, or their "
    "fit stopped elsewhere."
)
HIGH_ORDER = HighOrderNcpa.name  # what common modes of a ramp are
EFFECTS = "One value for all frames, with its standard error, grown by the misfit."
LAW = (
    "The law is that of a star without NCPAs, over the range in which it is used (shaded). The "
    "elongation sees the NCPAs as well: their defocus moves the points sideways, their "
    "astigmatism changes the slope. The prior is where a fit starts, not what it finds."
)
Ramp = StageData[LiftResults]
Prior = StageData[PriorResults]


def lift_section(run: RunData) -> Section:
    of = run.of(LiftResults)
    results, own = of.results, own_text(of.results.effects)
    common = "fitted to all frames together" if HIGH_ORDER in results.effects_sigma else "left out"
    ncpas = "in the known wavefront" if results.calibrated else common
    lead = (
        f"Noll {', '.join(map(str, results.modes))} of {plural(len(results.points), 'frame')}; "
        f"NCPAs {ncpas}{f', to which {own}' if own else ''}."
    )
    return Section(of.stage, "Defocus ramp (LIFT)", lead, of.blocks(_ramp, _tables, _chi2, _twin, _strip))


def _ramp(of: Ramp) -> Figure | None:
    """Estimated against introduced defocus with the 1:1 line, and their difference below."""
    points = [point for point in of.results.points if np.isfinite(point.introduced_nm)]
    if not points:
        return None
    names = ("introduced_nm", "defocus_nm", "sigma_nm", "converged")
    introduced, defocus, sigma, converged = (
        np.array([getattr(one, name) for one in points]) for name in names
    )
    direction, x = travel_direction(introduced).astype(int), _spread_out(introduced)
    missing = int(np.sum(~np.isfinite(defocus)))
    lost = f" {plural(missing, 'frame')} without estimate." if missing else ""

    def draw(canvas: Canvas) -> None:
        top, bottom = canvas.subplots(2, sharex=True, height_ratios=(3, 2))
        ends = [np.min(introduced), np.max(introduced)]
        top.plot(ends, ends, color=INK, linewidth=0.9, label="1:1")
        bottom.axhline(0, color=INK, linewidth=0.9)
        for axes, y in ((top, defocus), (bottom, defocus - introduced)):
            for travelled, (label, marker, colour) in TRAVEL.items():
                chosen = (direction == travelled) & np.isfinite(y)
                look = {"fmt": marker, "color": colour, "markersize": 4, "linewidth": 0.8, "label": label}
                if chosen.any():
                    axes.errorbar(x[chosen], y[chosen], np.nan_to_num(sigma[chosen]), **look)
            failed = ~converged & np.isfinite(y)
            if failed.any():
                axes.plot(x[failed], y[failed], "x", color=INK, markersize=7, label="not converged")
        top.set(ylabel="estimated defocus [nm RMS]")
        canvas.legend(*top.get_legend_handles_labels(), **BESIDE["below"])
        bottom.set(xlabel="introduced defocus [nm RMS]", ylabel="estimated −\nintroduced [nm]")

    return figure("ramp", (4.8, 4.8), draw, "Ramp", f"{RAMP}{lost}")


def _spread_out(introduced_nm: np.ndarray) -> np.ndarray:
    """Frames of one offset side by side, in order of time."""
    offsets, group, count = np.unique(introduced_nm, return_inverse=True, return_counts=True)
    step = np.min(np.diff(offsets)) if len(offsets) > 1 else 1.0
    place = np.array([np.sum(group[:i] == group[i]) for i in range(len(group))])
    return introduced_nm + SPREAD * step * ((place + 0.5) / count[group] - 0.5)


def _tables(of: Ramp) -> Stack:
    results = of.results
    lines = {"as configured": results.summary} | results.compare
    variants = Table.of(
        lines.items(),
        {
            "model": lambda one: one[0],
            "slope": lambda one: with_error(one[1].slope, one[1].slope_sigma, ".4f"),
            "offset [nm]": lambda one: number(one[1].offset_nm, "+.1f"),
            "error [nm RMS]": lambda one: number(one[1].rms_nm),
            "about the line [nm RMS]": lambda one: number(one[1].residual_rms_nm),
            "saw-tooth [nm]": lambda one: with_error(one[1].saw_tooth_nm, one[1].saw_tooth_sigma_nm, "+.1f"),
        },
        "Contribution of each part of the model" if len(lines) > 1 else "Ramp in numbers",
        "Saw-tooth: offsets reached upwards minus those reached downwards, fitted with the line.",
    )
    offsets = Table.of(
        results.offsets,
        {
            "introduced [nm]": lambda one: number(one.introduced_nm, "+.1f"),
            "median [nm]": lambda one: number(one.median_nm, "+.1f"),
            "1σ over frames [nm]": lambda one: number(one.scatter_nm),
        },
        "Median per offset",
        folded=len(results.offsets) > MOST_OFFSETS,
    )
    fitted = {name: values for name, values in results.effects.items() if name in results.effects_sigma}
    table = effects_table("Fitted to the ramp", fitted, results.effects_sigma, EFFECTS)
    return Stack(shown(variants, table, offsets))


def effects_table(
    title: str, effects: Mapping[str, EffectValues], sigma: Mapping[str, EffectValues], caption: str
) -> Table:
    """Return the parameters of `effects` with their errors `sigma`, by effect."""
    rows = [
        ("" if place else effect_link(effect), *row)
        for effect, values in effects.items()
        for place, row in enumerate(parameter_rows(values, sigma.get(effect)))
    ]
    return Table(("effect", "parameter", "value", "unit"), rows, title, caption)


def _chi2(of: Ramp) -> Figure | None:
    """χ²/ν of every frame, what a right model would give, and the limit of the median."""
    chi2_nu, nominal = np.array([point.chi2_nu for point in of.results.points]), of.results.nominal_chi2_nu
    limit = (of.run.products[of.stage].config.get("max_chi2_ratio") or np.nan) * nominal
    if not np.any(np.isfinite(chi2_nu)):
        return None

    def draw(axes: Axes) -> None:
        axes.plot(np.arange(len(chi2_nu)), chi2_nu, ".", color=BLUE)
        for label, level, colour in (("nominal", nominal, GREEN), ("limit of the median", limit, ORANGE)):
            if is_known(level):
                stated = f"{label}, {number(level, '.2f')}"
                axes.axhline(level, color=colour, linestyle="--", linewidth=1.0, label=stated)

    return plot("ramp-chi2", draw, ("frame", "χ²/ν"), "χ² of every frame", SERIES, ylim=(0, None))


def _twin(of: Ramp) -> Figure | None:
    """χ²/ν of one frame against the defocus it is held at, with the best fit and its twin marked."""
    focus_nm, chi2_nu, twin = of["curve_defocus_nm"], of["curve_chi2_nu"], of.results.twin
    if not np.isfinite(chi2_nu).any():
        return None

    def draw(axes: Axes) -> None:
        axes.plot(focus_nm, chi2_nu, color=BLUE)
        log_y(axes, chi2_nu)
        axes.plot(twin.defocus_nm, twin.chi2_nu, "o", color=BLUE, label="best fit")
        if np.isfinite(twin.twin_nm):
            axes.plot(twin.twin_nm, twin.twin_chi2_nu, "s", color=ORANGE, label="twin")

    caption = f"Frame {twin.frame} of {twin.name}, whose χ²/ν is the median. {TWIN} {_twin_said(twin)}"
    title = "Is the twin excluded?"
    return plot("ramp-twin", draw, ("defocus [nm RMS]", "χ²/ν"), title, caption)


def _twin_said(twin: Twin) -> str:
    if not np.isfinite(twin.twin_nm):
        return "There is no other minimum: the twin is excluded."
    size = f"= {twin.delta_chi2:,.0f}" if twin.delta_chi2 < BEYOND_DOUBT else f"> {BEYOND_DOUBT:,}"
    fits = f"The other minimum, at {twin.twin_nm:+.0f} nm, has Δχ² {size}"
    if twin.chi2_nu > 1 and twin.evidence < BEYOND_DOUBT:
        fits += f", {twin.evidence:,.0f} in units of the misfit"
    if twin.evidence >= DECISIVE:
        return f"{fits}: it is excluded."
    if twin.evidence <= -DECISIVE:
        return f"{fits}: it fits better, and the estimate of this frame is wrong."
    return f"{fits}: it is not excluded, and the sign of defocus is open."


def _strip(of: Ramp) -> Figure | None:
    offsets, measured, model = (
        of[name] for name in ("offsets_nm", "measured_per_offset_e", "model_per_offset_e")
    )
    if len(offsets) == 0:
        return None
    limit = residual_limit(measured, model)
    caption = "Every offset over the peak of its model; white bar: {}; residual: measured − model."
    scale_mas, columns = of.pixel_scale_mas, measured.shape[2]
    bar_px = 10 if not scale_mas else max(1, round(columns / 4))
    length = number(bar_px * (scale_mas or 1.0), ".0f", "mas" if scale_mas else "px")
    drawing = image_strip(offsets, measured, model, limit, bar_px)
    width: Width = "full" if len(offsets) > FEW_OFFSETS else "half"
    return Figure(drawing, "Mean image per offset", caption.format(length), width, "ramp-images")


def image_strip(
    offsets_nm: np.ndarray,
    measured: np.ndarray,
    model: np.ndarray,
    limit: float,
    bar_px: int = 0,
    name: str = "ramp-images",
) -> Markup:
    """Draw measured, model and residual (offsets, rows, columns) over the peak of each model.

    The scale of the residual ends at `limit`; a bar in the first image is `bar_px` long. `name` is that of
    the drawing.
    """
    chosen = np.unique(np.linspace(0, len(offsets_nm) - 1, min(STRIP_COLUMNS, len(offsets_nm))).astype(int))
    peaks = np.max(model[chosen], axis=(1, 2), initial=0.0, where=np.isfinite(model[chosen]))[:, None, None]
    over = 1 / np.where(peaks > 0, peaks, 1.0)
    images = {"measured": measured[chosen] * over, "model": model[chosen] * over}
    rows = {name: (one, brightness_scale(*images.values()), BRIGHTNESS) for name, one in images.items()}
    rows["residual"] = (images["measured"] - images["model"], symmetric_scale(limit), SIGNED)

    def draw(canvas: Canvas) -> None:
        grid = canvas.subplots(3, len(chosen), squeeze=False)
        for line, (label, (stack, norm, colours)) in zip(grid, rows.items(), strict=True):
            for axes, image in zip(line, stack, strict=True):
                shown = axes.imshow(image, norm=norm, cmap=colours, origin="lower", interpolation="none")
                axes.grid(False)
                axes.set(xticks=[], yticks=[])
            line[0].set_ylabel(label)
            bar = canvas.colorbar(shown, ax=line, label="part of the peak", fraction=0.03, pad=0.01)
            label_bar(bar.ax, norm)
        for axes, offset in zip(grid[0], offsets_nm[chosen], strict=True):
            axes.set_title(number(offset, "+.0f", "nm"))
        grid[0, 0].plot([2, 2 + bar_px], [2, 2], color="white", linewidth=2)

    return svg(name, (1.0 + CELL_IN * len(chosen), 0.3 + 3 * CELL_IN), draw)


def residual_limit(measured: np.ndarray, model: np.ndarray) -> float:
    """Return the colour limit of the residual panels, as a fraction of the model's peak."""
    peaks = np.max(model, axis=(1, 2), initial=0.0, where=np.isfinite(model))[:, None, None]
    return percentile(PERCENTILE, (measured - model) / np.where(peaks > 0, peaks, 1.0)) or 1.0


# -- prior -------------------------------------------------------------------------------------


def prior_section(run: RunData) -> Section:
    of = run.of(PriorResults)
    results, (low, high) = of.results, of.results.valid_nm
    scatter = number(results.law_residual_nm, ".0f", "nm")
    slope, offset = number(results.A, ".0f", "nm"), number(results.B, "+.0f", "nm")
    lead = (
        f"defocus = {slope} · (σ₁/σ₂ − 1) {offset}, from {number(low, '.0f')} to {number(high, '.0f', 'nm')}"
        + (f"; the law departs {scatter} RMS from the model." if scatter != MISSING else ".")
    )
    return Section(of.stage, "Elongation prior", lead, of.blocks(_law))


def _law(of: Prior) -> Figure:
    ratio, introduced, results = of["ratio"], of["introduced_nm"], of.results
    defocus = np.array(results.valid_nm)

    def draw(axes: Axes) -> None:
        many = len(introduced) > MANY
        axes.plot(introduced, ratio, "o", color=BLUE, markersize=3, label="frames", rasterized=many)
        if results.A and np.isfinite([results.A, results.B, *defocus]).all():
            axes.axvspan(defocus.min(), defocus.max(), color=FAINT, alpha=0.35, linewidth=0)
            law = 1 + (defocus - results.B) / results.A
            axes.plot(defocus, law, color=ORANGE, label="law without NCPAs")

    labels = ("introduced defocus [nm RMS]", "axis ratio σ₁/σ₂")
    return plot("prior-law", draw, labels, "Axis ratio against introduced defocus", LAW, "half", (4.4, 2.9))


# -- sensitivity: error and failures against magnitude -----------------------------------------

CAPTION = (
    f"Bands: 16th to 84th percentile. Dashed: Cramér–Rao bound times {MEDIAN_OF_NORMAL}, the median "
    "|error| of an efficient estimate; dotted: the same of exposures of one read without sky. Horizontal and "
    "vertical lines: criterion and limiting magnitudes. Errors are against the introduced defocus: without "
    "NCPAs, theirs counts as an error."
)
Sensitivity = StageData[SensitivityResults]


def sensitivity_section(run: RunData) -> Section:
    of = run.of(SensitivityResults)
    trials = [row.trials for row in of.results.curves if row.trials is not None]
    lead = (
        f"Frames dimmed to fainter stars, {max(trials)} estimates per magnitude. Errors are those of single "
        "frames against the introduced defocus."
        if trials
        else ""
    )
    return Section(of.stage, "Sensitivity", lead, of.blocks(_curves, _limits) if of.results.curves else [])


def _curves(of: Sensitivity) -> Figure:
    curves = [(row.label, row) for row in of.results.curves]
    drawing = sensitivity_plot("sensitivity", curves, of.results.criterion)
    return Figure(drawing, "Defocus error against magnitude", CAPTION)


def _limits(of: Sensitivity) -> Stack:
    criterion, noise = of.results.criterion, of.results.noise
    limits = Table.of(
        of.results.curves,
        {
            "NCPAs": lambda row: "added" if row.calibrated else "left out",
            "modes": lambda row: ", ".join(map(str, row.modes)),
            "limit [J mag]": limit_text,
            "limit of the bound, one read without sky [J mag]": lambda row: number(row.one_read_bound_mag),
            "median |error| of the brightest [nm]": lambda row: number(
                next(iter(row.median_abs_error_nm), None)
            ),
        },
        "Limiting magnitude",
        f"Faintest magnitude with median |error| ≤ {number(criterion.median_abs_error_nm, '.0f', 'nm')} "
        f"and ≤ {number(criterion.failures, '.0%')} failures; "
        f"≥: the magnitudes end before. {MISSING}: met at no magnitude.",
    )
    return Stack([limits] if noise.reads is None else [limits, _noise(noise)])


def _noise(noise: NoiseRow) -> Table:
    """What the dimmed frames are noisier by than one read without sky."""
    read_e, factor = number(noise.read_noise_e, ".2g"), number(noise.excess_noise_factor, ".2f")
    floors = (number(floor, ".3g") for floor in (noise.floor_e2, noise.one_read_floor_e2))
    rows = [
        ("reads in an exposure", str(noise.reads), "1"),
        ("noise of a read [e⁻]", read_e, read_e),
        (
            "sky + dark [e⁻ per pixel]",
            f"{number(noise.sky_e, '.2f')} + {number(noise.dark_e, '.2f')}",
            "0 + 0",
        ),
        ("excess noise factor", factor, "1.00"),
        ("variance without star [e⁻²]", *floors),
    ]
    ratio = number(noise.floor_e2 / noise.one_read_floor_e2, ".3g")
    text = f"The variance without star is {ratio} times that of one read without sky."
    return Table(("", "dimmed frames", "one read without sky"), rows, "Noise of a pixel", text)


def noise_text(noise: NoiseRow) -> str:
    """Return in a few words what the dimmed frames are noisy by; nothing where that is not known."""
    if noise.reads is None:
        return ""
    sky = number(noise.sky_e, ".2g", "e⁻/px of sky")
    return f"{sky}, {plural(noise.reads, 'read')} of {number(noise.read_noise_e, '.2g', 'e⁻')}"


def limit_text(row: CurveRow) -> str:
    """Return the limiting magnitude of a curve; with ``≥`` where the magnitudes end before."""
    return ("≥ " if row.at_the_end else "") + number(row.limit_mag)


# -- drawing -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Look:
    """How a curve is drawn; only a `main` one has its spread, its bound and its limit drawn too."""

    colour: str
    marker: str
    main: bool = True


LOOKS = tuple(map(Look, CYCLE, ("o", "s", "^", "D", "v", "P")))


def sensitivity_plot(
    name: str,
    curves: Sequence[tuple[str, CurveRow]],
    criterion: CriterionRow,
    looks: Sequence[Look] = LOOKS,
    floor_nm: float | None = None,
) -> Markup:
    """Draw median errors above and failures below, with the `criterion` as levels, of labelled `curves`.

    Fewer `looks` than curves are repeated; `floor_nm` is the median error of a perfect sensor.
    """

    def draw(canvas: Canvas) -> None:
        top, bottom = canvas.subplots(2, sharex=True, height_ratios=(3, 1))
        for place, (label, row) in enumerate(curves):
            look = looks[place % len(looks)]
            colour, mag_j, width = look.colour, row.mag_j, 1.4 if look.main else 0.8
            points: dict[str, Any] = {"markersize": 3.5, "linewidth": width, "label": label}
            top.plot(mag_j, row.values("median_abs_error_nm"), f"{look.marker}-", color=colour, **points)
            if look.main:
                ends = row.values("p16_nm"), row.values("p84_nm")
                top.fill_between(mag_j, *ends, color=colour, alpha=0.15, linewidth=0)
                for bound, style in (("crb_nm", "--"), ("one_read_crb_nm", ":")):
                    top.plot(mag_j, MEDIAN_OF_NORMAL * row.values(bound), style, color=colour, linewidth=0.9)
                if np.isfinite(row.limit_mag):
                    top.axvline(row.limit_mag, color=colour, linewidth=0.8, linestyle=":")
            failed = row.values("failures") / (row.trials or np.nan)
            bottom.plot(row.mag_j, 100 * failed, f"{look.marker}-", color=look.colour, markersize=3.5)
        _draw_level(top, floor_nm, 1, ":", "AO residual's own defocus")
        _draw_level(top, criterion.median_abs_error_nm, 1, "-.")
        _draw_level(bottom, criterion.failures, 100, "-.")
        top.set_ylabel("median |error| [nm RMS]")
        log_y(top, *(row.values("median_abs_error_nm") for _, row in curves))
        canvas.legend(loc="outside upper center", ncols=2)
        bottom.set(xlabel="J magnitude", ylabel="failures [%]")
        bottom.set_ylim(bottom=-2)

    return svg(name, (5.2, 4.8), draw)


def _draw_level(axes: Axes, level: float | None, factor: float, style: str, label: str | None = None) -> None:
    if level is not None and np.isfinite(level):
        axes.axhline(factor * level, color=INK, linewidth=0.8, linestyle=style, label=label)
