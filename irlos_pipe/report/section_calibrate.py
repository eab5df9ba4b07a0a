"""Section on the calibration: images, NCPAs, wavefront, behaviour in time, methods side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.optics.wavefront import MapSize
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table, Views
from irlos_pipe.report.drawing import BLUE, CYCLE, GREEN, INK, ORANGE, svg
from irlos_pipe.report.effect_words import parameter_rows
from irlos_pipe.report.image_views import image_views, residual_views
from irlos_pipe.report.images import PANEL_IN, SIGNED, panel_axes, symmetric_scale
from irlos_pipe.report.misfit_plots import quantile_figures
from irlos_pipe.report.quality_plots import Look, power_figures
from irlos_pipe.report.radial import star_profile
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, is_known, mode_label, number, plural, with_error
from irlos_pipe.report.wavefront_plots import wavefront_map
from irlos_pipe.stages.calibrate.results import CalibrateResults, Estimate
from irlos_pipe.stages.correct import CorrectResults

STAGE = "calibrate"
MODES_IN_TIME = 5
MAP_PERCENTILE = 97  # the very edge of the pupil would swallow the scale
LEFT = {"": Look("residual", BLUE)}
EFFECTS = "Standard errors, from the scatter of the frames where there are enough, grown by the misfit."
METHOD_COLUMNS = (
    "method",
    "NCPA [nm RMS]",
    "defocus [nm]",
    "χ²/ν",
    "modes",
    "loss, optimiser",
    "converged",
    "time [s]",
)
WIDTH_IN, BAR_IN = 4.4, 0.165
MARKERS = ("o", "s", "D", "^", "v")
CUBE_COLUMNS = ("recording", "derotator [°]", "NCPA [nm RMS]", "defocus [nm]", "χ²/ν", "frames")


def calibrate_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(CalibrateResults)
    blocks: list[Block] = [
        *_images(run, results),
        *_maps(run),
        *_profile(run),
        *power_figures(run, STAGE, "cal-power", LEFT),
        *_quantiles(run),
        *_correlations(run),
        *_bars(results),
        *_in_time(run),
        Stack([*_effects(results), *_cubes(results), *_methods(results)]),
    ]
    return Section(STAGE, "NCPA calibration", _lead(run, results), blocks)


def _lead(run: RunData, results: CalibrateResults) -> str:
    names = ", ".join(recording.name for recording in run.recordings_of(STAGE))
    mean = "; every recording by itself, mean over them" if results.cubes else ""
    return (
        f"{results.method} on {plural(results.frames, 'used frame')}"
        f"{f' of {names}' if names else ''}{mean}; diversity not included in the coefficients."
    )


def _images(run: RunData, results: CalibrateResults) -> list[Views]:
    measured, model = run.array(STAGE, "mean_image_e"), run.array(STAGE, "model_image_e")
    if measured is None or model is None:
        return []
    mas, good = run.pixel_scale_mas(STAGE), _good_pixels(run)
    images = {
        "Measured": (measured, "Mean of the used frames; crosses: masked pixels."),
        "Model": (model, "Same scale."),
    }
    sigma_e = run.error_of(STAGE, "mean_image_e")
    if sigma_e is not None and good is not None:
        sigma_e = np.where(good, sigma_e, np.nan)
    residual = {"Residual": (measured - model, _caption(results))}
    peak_e = float(np.nanmax(model, initial=0.0))
    return [
        image_views("cal-images", images, mas, good, "two-thirds"),
        residual_views("cal-residual", residual, sigma_e, peak_e, mas, "third"),
    ]


def _quantiles(run: RunData) -> list[Figure]:
    measured, model = run.array(STAGE, "mean_image_e"), run.array(STAGE, "model_image_e")
    sigma_e, good = run.error_of(STAGE, "mean_image_e"), _good_pixels(run)
    if measured is None or model is None or sigma_e is None:
        return []
    counted = (sigma_e > 0) if good is None else good & (sigma_e > 0)
    residual = np.divide(measured - model, sigma_e, out=np.full(measured.shape, np.nan), where=counted)
    return quantile_figures("cal-quantiles", {LEFT[""]: residual})


def _caption(results: CalibrateResults) -> str:
    nominal = number(results.nominal_chi2_nu, ".2f")
    told = "" if nominal == MISSING else f", where a complete model gives {nominal} with as many parameters"
    return f"Measured − model; χ²/ν {_chi2(results)}{told}."


def _good_pixels(run: RunData) -> np.ndarray | None:
    masks = [recording.good for recording in run.recordings_of(STAGE)]
    return np.all(masks, axis=0) if masks and len({mask.shape for mask in masks}) == 1 else None


def _chi2(results: Estimate) -> str:
    return number(results.chi2_nu, ".2f")


def _profile(run: RunData) -> list[Figure]:
    measured, model = run.array(STAGE, "mean_image_e"), run.array(STAGE, "model_image_e")
    if measured is None or model is None:
        return []
    mas, good, sigma = run.pixel_scale_mas(STAGE), _good_pixels(run), run.error_of(STAGE, "mean_image_e")
    images = {
        "measured": (measured, INK, "o"),
        "model": (model, BLUE, "-"),
        "|residual|": (np.abs(measured - model), ORANGE, "-"),
    }
    if sigma is not None:
        images["1σ noise"] = (sigma, GREEN, "--")
    if good is not None:
        images = {key: (np.where(good, one[0], np.nan), *one[1:]) for key, one in images.items()}
    plot = star_profile("cal-profile", images, model, mas)
    return [Figure(plot, "Radial profile", "About the star's centroid.", "third")]


def _bars(results: CalibrateResults) -> list[Figure]:
    nolls = sorted(results.zernike_nm)
    if not nolls:
        return []
    others = {other.method: _in_order(other.zernike_nm, nolls) for other in results.compare}
    values, sigma = (_in_order(one, nolls) for one in (results.zernike_nm, results.sigma_nm))
    bars = coefficient_bars("cal-ncpa", nolls, values, sigma, others)
    symbols = "; symbols: other methods" if others else ""
    return [Figure(bars, "NCPAs by Noll mode", f"Bars: {results.method} with 1σ{symbols}.")]


def _in_order(values: Mapping[int, float], nolls: Sequence[int]) -> np.ndarray:
    """Values in the order of `nolls`; NaN for modes that were not estimated."""
    return np.array([values.get(noll, np.nan) for noll in nolls])


def _maps(run: RunData) -> list[Figure]:
    stored = {when: run.array("correct", f"wavefront_{when}_nm") for when in ("before", "after")}
    maps = {when: opd for when, opd in stored.items() if opd is not None and np.isfinite(opd).any()}
    if len(maps) < len(stored):
        return []
    limit = max(float(np.nanpercentile(np.abs(opd), MAP_PERCENTILE)) for opd in maps.values()) or 1.0
    correct = run.results(CorrectResults)
    rows = {"before": correct.wavefront_before, "after": correct.wavefront_after}
    captions = {
        "before": "Estimated wavefront without tip and tilt",
        "after": "Estimated modes beyond those that are corrected, same scale",
    }
    return [
        Figure(
            wavefront_map(f"wavefront-{when}", opd, limit),
            f"{when.capitalize()} correction: {_sizes(rows[when])}",
            f"{captions[when]}; the scale leaves out the rim. {orientation(run)}",
            "third",
        )
        for when, opd in maps.items()
    ]


def _sizes(row: MapSize) -> str:
    return f"{number(row.rms_nm, '.0f', 'nm RMS')}, {number(row.pv_nm, '.0f', 'nm PV')}"


def orientation(run: RunData) -> str:
    """Return how a map of the pupil lies: as the images, with the angles that were told."""
    recordings = run.recordings_of(STAGE)
    angles = {f"{one.acquisition.derotator_angle_deg:g}°" for one in recordings}
    told = [f"derotator {', '.join(sorted(angles))}"] if angles else []
    parallactic = {one.acquisition.parallactic_angle_deg for one in recordings}
    told += [f"parallactic angle {number(one, '.1f')}°" for one in parallactic if is_known(one)][:1]
    return f"x and y as in the images, +x right and +y up{'; ' if told else ''}{', '.join(told)}."


def _correlations(run: RunData) -> list[Figure]:
    correlation, nolls = run.array(STAGE, "correlation"), run.array(STAGE, "noll")
    if correlation is None or nolls is None or len(correlation) < 2:
        return []
    frames = run.results(CalibrateResults).frames
    chance = f" {plural(frames, 'frame')} give ±{frames**-0.5:.2f} by chance." if frames > 1 else ""
    caption = f"Of the errors of the reported modes: dark pairs are hardly told apart.{chance}"
    drawing = correlation_map(
        "cal-correlation", [int(noll) for noll in nolls[: len(correlation)]], correlation
    )
    return [Figure(drawing, "Correlations of the modes", caption, "third")]


def _in_time(run: RunData) -> list[Figure]:
    frames, nolls, adopted = (run.array(STAGE, name) for name in ("frames_nm", "noll", "zernike_nm"))
    if frames is None or nolls is None or adopted is None or len(frames) < 2:
        return []
    largest = np.argsort(-np.abs(np.nan_to_num(adopted)))[:MODES_IN_TIME]
    drawing = coefficients_in_time(
        "cal-time", [int(noll) for noll in nolls[largest]], frames[:, largest], adopted[largest]
    )
    return [Figure(drawing, "Largest modes frame by frame", "Orange: adopted value.")]


def _effects(results: CalibrateResults) -> list[Table]:
    rows = [
        ("" if place else effect, *row)
        for effect, values in results.effects.items()
        for place, row in enumerate(parameter_rows(values, results.effects_sigma.get(effect)))
    ]
    columns = ("effect", "parameter", "value", "unit")
    return [Table(columns, rows, "Estimated with the NCPAs", EFFECTS)] if rows else []


def _cubes(results: CalibrateResults) -> list[Table]:
    rows = [
        (
            cube.name,
            number(cube.derotator_angle_deg, "g"),
            with_error(cube.wfe_nm, cube.wfe_sigma_nm),
            number(cube.zernike_nm.get(4), "+.1f"),
            _chi2(cube),
            number(cube.frames, "d"),
        )
        for cube in results.cubes
    ]
    return [Table(CUBE_COLUMNS, rows, "Recordings one by one")] if rows else []


def _methods(results: CalibrateResults) -> list[Table]:
    if not results.compare:
        return []
    return [Table(METHOD_COLUMNS, [_method_row(one) for one in (results, *results.compare)], "Methods")]


def _method_row(one: Estimate) -> tuple[str, ...]:
    return (
        one.method,
        number(one.wfe_nm),
        number(one.zernike_nm.get(4), "+.1f"),
        _chi2(one),
        number(one.modes_estimated, "d"),
        f"{one.loss}, {one.optimiser}",
        f"{one.status.get('converged', 0)} of {sum(one.status.values())}",
        number(one.seconds),
    )


# -- drawings ----------------------------------------------------------------------------------


def coefficient_bars(
    name: str,
    nolls: Sequence[int],
    values_nm: np.ndarray,
    sigma_nm: np.ndarray,
    others_nm: Mapping[str, np.ndarray],
) -> Markup:
    """Draw one bar with its error per mode, and other methods as symbols.

    Parameters
    ----------
    name : str
        Unique in the page.
    nolls : sequence of int
    values_nm, sigma_nm : ndarray, (modes,)
    others_nm : mapping of str to ndarray, (modes,)
        Coefficients of other methods.
    """
    rows = np.arange(len(nolls))

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        error_look = {"ecolor": INK, "elinewidth": 0.9}
        axes.barh(rows, values_nm, 0.75, color=BLUE, xerr=np.nan_to_num(sigma_nm), error_kw=error_look)
        _draw_others(axes, rows, others_nm)
        axes.axvline(0, color=INK, linewidth=0.7)
        axes.set(yticks=rows, yticklabels=[mode_label(noll) for noll in nolls], ylim=(len(nolls) - 0.4, -0.6))
        axes.set_xlabel("coefficient [nm RMS]")
        axes.grid(axis="y", visible=False)
        if others_nm:
            figure.legend(loc="outside lower center", ncols=3)

    return svg(name, (WIDTH_IN, 0.7 + BAR_IN * len(nolls)), draw)


def _draw_others(axes: Axes, rows: np.ndarray, others_nm: Mapping[str, np.ndarray]) -> None:
    for place, (name, values_nm) in enumerate(others_nm.items()):
        colour, marker = CYCLE[1 + place % (len(CYCLE) - 1)], MARKERS[place % len(MARKERS)]
        axes.plot(values_nm, rows, marker, color=colour, markersize=3.5, label=name)


def correlation_map(name: str, nolls: Sequence[int], correlation: np.ndarray) -> Markup:
    """Draw a matrix of correlations.

    Parameters
    ----------
    name : str
        Unique in the page.
    nolls : sequence of int
        Of the modes, (modes,).
    correlation : ndarray, (modes, modes)
    """
    scale, edges = symmetric_scale(1.0), (nolls[0] - 0.5, nolls[-1] + 0.5)

    def draw(figure: Canvas) -> None:
        axes, bar = panel_axes(figure)
        shown = axes.imshow(
            correlation, norm=scale, cmap=SIGNED, interpolation="none", extent=(*edges, *edges[::-1])
        )
        axes.set(xlabel="Noll", ylabel="Noll")
        figure.colorbar(shown, cax=bar, label="correlation", ticks=(-1, -0.5, 0, 0.5, 1))

    return svg(name, PANEL_IN, draw)


def coefficients_in_time(
    name: str, nolls: Sequence[int], frames_nm: np.ndarray, mean_nm: np.ndarray
) -> Markup:
    """Draw the coefficients of every frame, one row per mode, with the adopted value.

    Parameters
    ----------
    name : str
        Unique in the page.
    nolls : sequence of int
    frames_nm : ndarray, (frames, modes)
    mean_nm : ndarray, (modes,)
    """

    def draw(figure: Canvas) -> None:
        stack = figure.subplots(len(nolls), sharex=True, squeeze=False)[:, 0]
        for axes, noll, values, mean in zip(stack, nolls, frames_nm.T, mean_nm, strict=True):
            axes.plot(values, ".-", color=BLUE, markersize=2, linewidth=0.5)
            axes.axhline(mean, color=ORANGE, linewidth=1.2)
            axes.set_title(f"{mode_label(noll)} [nm]", loc="left", pad=2)
            axes.locator_params(axis="y", nbins=4)
        stack[-1].set_xlabel("used frame")

    return svg(name, (WIDTH_IN, 0.5 + 0.85 * len(nolls)), draw)
