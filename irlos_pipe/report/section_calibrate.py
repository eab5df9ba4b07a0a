"""Section on the calibration: images, NCPAs, wavefront, behaviour in time, methods side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.effects.public_values import rows_of
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table
from irlos_pipe.report.drawing import BLUE, CYCLE, GREEN, INK, ORANGE, svg
from irlos_pipe.report.images import SIGMA_LIMIT, SIGNED, brightness_scale, image_panel, symmetric_scale
from irlos_pipe.report.radial import star_profile
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import mode_label, number, plural, with_error
from irlos_pipe.report.wavefront_plots import wavefront_map
from irlos_pipe.stages.calibrate.results import CalibrateResults, Estimate

STAGE = "calibrate"
BRIGHTNESS_UNIT = "e⁻ (asinh scale)"
MODES_IN_TIME = 5
MAP_PERCENTILE = 99  # the very edge of the pupil would swallow the scale
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
        *_bars(results),
        Stack([*_profile(run), *_maps(run)]),
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


def _images(run: RunData, results: CalibrateResults) -> list[Figure]:
    measured, model = run.array(STAGE, "mean_image_e"), run.array(STAGE, "model_image_e")
    if measured is None or model is None:
        return []
    scale, mas = brightness_scale(measured, model), run.pixel_scale_mas(STAGE)
    pictures = [
        image_panel("cal-measured", measured, scale, mas, BRIGHTNESS_UNIT, good=_good_pixels(run)),
        image_panel("cal-model", model, scale, mas, BRIGHTNESS_UNIT),
    ]
    return [
        Figure(pictures[0], "Measured", "Mean of the used frames; crosses: masked pixels.", "third"),
        Figure(pictures[1], "Model", "Same scale.", "third"),
        *_residual(run, results, measured - model),
    ]


def _residual(run: RunData, results: CalibrateResults, residual_e: np.ndarray) -> list[Figure]:
    sigma_e = run.error_of(STAGE, "mean_image_e")
    if sigma_e is None:
        return []
    image, scale = _in_sigma(residual_e, sigma_e, _good_pixels(run)), symmetric_scale(SIGMA_LIMIT)
    panel = image_panel("cal-residual", image, scale, run.pixel_scale_mas(STAGE), "σ", SIGNED)
    return [Figure(panel, "Residual", f"Measured − model; χ²/ν {_chi2(results)}.", "third")]


def _good_pixels(run: RunData) -> np.ndarray | None:
    masks = [recording.good for recording in run.recordings_of(STAGE)]
    return np.all(masks, axis=0) if masks and len({mask.shape for mask in masks}) == 1 else None


def _in_sigma(residual: np.ndarray, sigma: np.ndarray, good: np.ndarray | None) -> np.ndarray:
    usable = (sigma > 0) & (True if good is None else good)
    return np.divide(residual, sigma, out=np.full(residual.shape, np.nan), where=usable)


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
    return [Figure(plot, "Radial profile", "About the star's centroid.", "full")]


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
    captions = {
        "before": "Estimated wavefront without tip and tilt.",
        "after": "Estimated modes beyond those that are corrected; same scale.",
    }
    return [
        Figure(
            wavefront_map(f"wavefront-{when}", opd, limit),
            f"Wavefront {when} correction",
            captions[when],
            "third",
        )
        for when, opd in maps.items()
    ]


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
        ("" if place else effect, name, number(value, ".4g"))
        for effect, values in results.effects.items()
        for place, (name, value) in enumerate(rows_of(values))
    ]
    return [Table(("effect", "parameter", "value"), rows, "Estimated with the NCPAs")] if rows else []


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
