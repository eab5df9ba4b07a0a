"""Sections on the calibration, with images, NCPAs, wavefront and methods, and on the correction."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib import mlab
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.optics.wavefront import opd_sigma_nm
from irlos_pipe.optics.zernike import noll_to_nm
from irlos_pipe.product.results import provenance_of
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table, Text, Views, shown
from irlos_pipe.report.drawing import (
    BESIDE,
    BLUE,
    CYCLE,
    FAINT,
    FEWEST,
    GREEN,
    INK,
    MARKERS,
    ORANGE,
    PREDICTED,
    SIZE_IN,
    Look,
    energy_figure,
    figure,
    log_y,
    otf_figure,
    plot,
    power_figure,
    power_of_ten,
    profile_plot,
    quantile_figure,
    star_profile,
)
from irlos_pipe.report.images import (
    BRIGHTNESS,
    PANEL_IN,
    image_panel,
    image_views,
    in_sigma,
    log_scale,
    panel,
    percentile,
    pupil_map,
    residual_views,
    symmetric_scale,
)
from irlos_pipe.report.run_data import RunData, StageData, frame_times
from irlos_pipe.report.section_lift import effects_table, image_strip, residual_limit
from irlos_pipe.report.section_run import advice, applicable
from irlos_pipe.report.text import (
    MISSING,
    effect_link,
    is_known,
    mode_label,
    mode_name,
    number,
    plural,
    with_error,
)
from irlos_pipe.stages.calibrate.stage import CalibrateResults, Estimate
from irlos_pipe.stages.correct import CorrectResults

MODES_IN_TIME = 5  # largest modes that are drawn against time
SEGMENT = 128  # frames of a segment of which power spectra are averaged
MAP_PERCENTILE = 97  # end of the scale: the very edge of the pupil would swallow it
PUPIL_AXES = {
    "xlabel": "x [pupil radii]",
    "ylabel": "y [pupil radii]",
    "xticks": (-1, 0, 1),
    "yticks": (-1, 0, 1),
}
LEFT = Look("residual", BLUE)
EFFECTS = "Standard errors, from the scatter of the frames where there are enough, grown by the misfit."
WIDTH_IN, BAR_IN = 4.4, 0.165
ROWS_PER_TABLE = 10
HIGHER = "wavefront [nm]"
BUDGET = (
    "Predicted with the effects as estimated, without diversity: brightest pixel over that of the image "
    "without aberrations. Small parts multiply; larger ones interfere, and the product is not that of all."
)
ENERGY = "Part of all light within a circle about the optical axis, predicted without diversity."
Calibration = StageData[CalibrateResults]
Correction = StageData[CorrectResults]


def calibrate_section(run: RunData) -> Section:
    of = run.of(CalibrateResults)
    blocks = of.blocks(
        _images,
        _planes,
        _profile,
        _cuts,
        partial(power_figure, name="cal-power", looks={"": LEFT}),
        _maps,
        _error_map,
        _quantiles,
        _correlations,
        _orders,
        _bars,
        _in_time,
        _tables,
    )
    results, names = of.results, ", ".join(recording.name for recording in of.recordings)
    mean = "; every recording by itself, mean over them" if results.cubes else ""
    if results.setups:
        mean = f"; {len(results.setups)} set-ups fitted together, images are those of the first"
    if results.adjusted:
        mean += "; facts of the instrument, not quite as declared, follow the images"
    lead = (
        f"{results.method} on {plural(results.frames, 'used frame')}"
        f"{f' of {names}' if names else ''}{mean}; diversity not included in the coefficients."
    )
    return Section(of.stage, "NCPA calibration", lead, blocks)


def _images(of: Calibration) -> list[Views]:
    measured, model, sigma = of["mean_image_e"], of["model_image_e"], _sigma(of)
    results, mas = of.results, of.pixel_scale_mas
    images = {
        "Measured": (measured, "Mean of the used frames; crosses: masked pixels."),
        "Model": (model, "Same scale."),
    }
    nominal = number(results.nominal_chi2_nu, ".2f")
    stated = "" if nominal == MISSING else f", nominal for a complete model {nominal}"
    caption = f"Measured − model; χ²/ν {number(results.chi2_nu, '.2f')}{stated}."
    residual = {"Residual": (measured - model, caption)}
    return [
        image_views("cal-images", images, mas, _good_pixels(of), "two-thirds"),
        residual_views("cal-residual", residual, sigma, float(np.nanmax(model, initial=0.0)), mas, "third"),
    ]


def _planes(of: Calibration) -> Figure | None:
    """Image, model and residual of every set-up."""
    if not of.results.setups:
        return None
    measured, model = of["setup_images_e"], of["setup_models_e"]
    order = np.argsort([one.introduced_nm for one in of.results.setups], kind="stable")
    known_nm = np.array([of.results.setups[one].introduced_nm for one in order])
    measured, model = measured[order], model[order]
    drawing = image_strip(known_nm, measured, model, residual_limit(measured, model), name="cal-planes")
    caption = "Every set-up over the peak of its model, by its known defocus; residual: measured − model."
    return Figure(drawing, "Set-ups fitted together", caption, "full", "cal-planes")


def _sigma(of: Calibration) -> np.ndarray | None:
    """Errors of the mean image; NaN for masked pixels."""
    sigma, good = of.error_of("mean_image_e"), _good_pixels(of)
    return sigma if sigma is None or good is None else np.where(good, sigma, np.nan)


def _good_pixels(of: Calibration) -> np.ndarray | None:
    masks = [recording.good for recording in of.recordings]
    return np.all(masks, axis=0) if masks and len({mask.shape for mask in masks}) == 1 else None


def _quantiles(of: Calibration) -> Figure | None:
    residual, sigma = of["mean_image_e"] - of["model_image_e"], _sigma(of)
    if sigma is None:
        return None
    left, results = in_sigma(residual, sigma), of.results
    squares = np.nanmean(left**2) if np.isfinite(left).any() else np.nan
    nominal = squares * results.nominal_chi2_nu / (results.chi2_nu or np.nan)
    return quantile_figure("cal-quantiles", {LEFT: left}, float(nominal))


def _profile(of: Calibration) -> Figure:
    measured, model, good = of["mean_image_e"], of["model_image_e"], _good_pixels(of)
    images = {
        "measured": (measured, INK, "o"),
        "model": (model, BLUE, "-"),
        "|residual|": (np.abs(measured - model), ORANGE, "-"),
    }
    sigma = of.error_of("mean_image_e")
    if sigma is not None:
        images["1σ noise"] = (sigma, GREEN, "--")
    if good is not None:
        images = {key: (np.where(good, one[0], np.nan), *one[1:]) for key, one in images.items()}
    drawing = star_profile("cal-profile", images, model, of.pixel_scale_mas)
    return Figure(drawing, "Radial profile", "About the star's centroid.", "third", "cal-profile")


def _cuts(of: Calibration) -> Figure:
    """Cuts along x and y through the brightest pixel of the model; what is not positive leaves gaps."""
    measured, model, mas = of["mean_image_e"], of["model_image_e"], of.pixel_scale_mas
    place = np.unravel_index(np.nanargmax(model), model.shape) if np.isfinite(model).any() else (0, 0)
    looks = (("measured", measured, ".", INK), ("model", model, "-", BLUE))

    def draw(canvas: Canvas) -> None:
        for axis, axes in enumerate(canvas.subplots(2, sharex=True, sharey=True)):
            for name, image, points, colour in looks:
                line = image[place[0]] if axis == 0 else image[:, place[1]]
                at = (np.arange(len(line)) - (len(line) - 1) / 2) * (mas or 1.0)
                look = {"color": colour, "label": None if axis else name, "markersize": 4}
                axes.plot(at, np.where(line > 0, line, np.nan), points, **look)
            axes.set(ylabel=f"along {'xy'[axis]} [e⁻]")
            log_y(axes, measured, model, small=True)
        axes.set_xlabel(f"from the centre of the window [{'mas' if mas else 'px'}]")
        canvas.legend(**BESIDE["above"])

    return figure("cal-cuts", SIZE_IN, draw, "Cuts along x and y", "Through the brightest pixel.", "third")


def _maps(of: Calibration) -> list[Figure]:
    correct = of.run.of(CorrectResults)
    maps = {when: correct[f"wavefront_{when}_nm"] for when in ("before", "after")}
    if not all(np.isfinite(opd).any() for opd in maps.values()):
        return []
    limit = max(percentile(MAP_PERCENTILE, opd) for opd in maps.values()) or 1.0
    captions = {
        "before": "All estimated modes without tip and tilt",
        "after": "Estimated modes beyond those that are corrected, same scale",
    }
    return [
        Figure(
            pupil_map(f"wavefront-{when}", opd, limit, "OPD [nm]", **PUPIL_AXES),
            f"Wavefront {when} correction",
            f"{captions[when]}; the scale leaves out the rim. {_orientation(of)}",
            "third",
            f"wavefront-{when}",
        )
        for when, opd in maps.items()
    ]


def _error_map(of: Calibration) -> Figure:
    """Standard error of the wavefront over the pupil, tip and tilt apart, on the map of the wavefront."""
    lit = np.isfinite(of.run.of(CorrectResults)["wavefront_before_nm"])
    nolls, covariance = of["noll"].astype(int), of["covariance_nm2"]
    own = ~np.isin(nolls, TIP_TILT)
    sigma = opd_sigma_nm(nolls[own].tolist(), covariance[np.ix_(own, own)], lit)
    scale = Normalize(0, percentile(MAP_PERCENTILE, sigma) or 1.0)
    drawing = panel(
        "wavefront-error",
        sigma,
        scale,
        "1σ of the OPD [nm]",
        lambda axes: axes.set(facecolor=FAINT, **PUPIL_AXES),
        BRIGHTNESS,
        "max",
        extent=(-1, 1, -1, 1),
    )
    caption = "Standard error at every place, tip and tilt apart, by the covariance of all modes."
    return Figure(drawing, "Error of the wavefront", caption, "third", "wavefront-error")


def _orientation(of: Calibration) -> str:
    """How a map of the pupil lies: as the images, with the angles that were declared."""
    angles = {f"{one.acquisition.derotator_angle_deg:g}°" for one in of.recordings}
    stated = [f"derotator {', '.join(sorted(angles))}"] if angles else []
    parallactic = {one.acquisition.parallactic_angle_deg for one in of.recordings}
    stated += [f"parallactic angle {number(one, '.1f')}°" for one in parallactic if is_known(one)][:1]
    return f"x and y as in the images, +x right and +y up{'; ' if stated else ''}{', '.join(stated)}."


def _correlations(of: Calibration) -> Figure | None:
    correlation = of["correlation"]
    nolls = of["noll"][: len(correlation)].astype(int)
    if len(correlation) < 2:
        return None
    frames = of.results.frames
    chance = f" {plural(frames, 'frame')} give ±{frames**-0.5:.2f} by chance." if frames > 1 else ""
    caption = f"Of the errors of the reported modes: dark pairs are hardly distinguished.{chance}"
    edges = (nolls[0] - 0.5, nolls[-1] + 0.5)

    def draw(axes: Axes) -> None:
        axes.set(xlabel="Noll", ylabel="Noll")

    look: dict[str, Any] = {
        "origin": "upper",
        "extent": (*edges, *edges[::-1]),
        "ticks": (-1, -0.5, 0, 0.5, 1),
    }
    drawing = panel("cal-correlation", correlation, symmetric_scale(1.0), "correlation", draw, **look)
    return Figure(drawing, "Correlations of the modes", caption, "third", "cal-correlation")


def _orders(of: Calibration) -> Figure:
    """RMS of all modes of each radial order, and their total error."""
    nolls, values, sigma = of["noll"].astype(int), of["zernike_nm"], of.error_of("zernike_nm")
    order = np.array([noll_to_nm(int(noll))[0] for noll in nolls])
    at = np.unique(order)

    def total(coefficients: np.ndarray) -> np.ndarray:
        return np.array([np.linalg.norm(coefficients[order == one]) for one in at])

    def draw(axes: Axes) -> None:
        axes.plot(at, total(values), "o-", color=BLUE, markersize=4, label="estimated")
        if sigma is not None:
            axes.plot(at, total(sigma), "--", color=ORANGE, label="standard error")
        log_y(axes, total(values))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))

    caption = "Root of the sum of squares of all modes of an order; order 1: tip and tilt."
    labels = ("radial order n", "wavefront [nm RMS]")
    return plot("cal-orders", draw, labels, "Wavefront by radial order", caption)


def _bars(of: Calibration) -> Figure | None:
    """A bar with its error for each mode, and other methods as symbols."""
    results, nolls = of.results, sorted(of.results.zernike_nm)
    if not nolls:
        return None
    rows = np.arange(len(nolls))

    def in_order(values: Mapping[int, float]) -> np.ndarray:
        return np.array([values.get(noll, np.nan) for noll in nolls])

    def draw(axes: Axes) -> None:
        error = np.nan_to_num(in_order(results.sigma_nm))
        look = {"ecolor": INK, "elinewidth": 0.9}
        axes.barh(rows, in_order(results.zernike_nm), 0.75, color=BLUE, xerr=error, error_kw=look)
        for place, other in enumerate(results.compare):
            colour, marker = CYCLE[1 + place % (len(CYCLE) - 1)], MARKERS[place % (len(MARKERS) - 1)]
            values = in_order(other.zernike_nm)
            axes.plot(values, rows, marker, color=colour, markersize=3.5, label=other.method)
        axes.axvline(0, color=INK, linewidth=0.7)
        axes.grid(axis="y", visible=False)

    symbols = "; symbols: other methods" if results.compare else ""
    return plot(
        "cal-ncpa",
        draw,
        ("coefficient [nm RMS]", ""),
        "NCPAs by Noll mode",
        f"Bars: {results.method} with 1σ{symbols}.",
        "half",
        (WIDTH_IN, 0.7 + BAR_IN * len(nolls)),
        legend="below",
        yticks=rows,
        yticklabels=[mode_label(noll) for noll in nolls],
        ylim=(len(nolls) - 0.4, -0.6),
    )


def _in_time(of: Calibration) -> Figure | None:
    """The largest modes against time, one row for each, and the power spectrum of each."""
    frames, nolls, adopted = (of[name] for name in ("frames_nm", "noll", "zernike_nm"))
    if len(frames) < 2 or of.results.setups:
        return None
    largest = np.argsort(-np.abs(np.nan_to_num(adopted)))[:MODES_IN_TIME]
    time_s, rate_hz = frame_times(of.recordings)
    timed = len(time_s) == len(frames) and np.isfinite(rate_hz)
    x_label = "time [s]" if timed else "used frame"
    spectra = timed and len(frames) >= FEWEST and np.isfinite(frames).all()

    def draw(canvas: Canvas) -> None:
        ratios = (3, 2) if spectra else (1,)
        grid = canvas.subplots(len(largest), len(ratios), sharex="col", squeeze=False, width_ratios=ratios)
        at = time_s if timed else np.arange(len(frames))
        for row, mode in zip(grid, largest, strict=True):
            row[0].plot(at, frames[:, mode], ".-", color=BLUE, markersize=2, linewidth=0.5)
            row[0].axhline(adopted[mode], color=ORANGE, linewidth=1.2)
            row[0].set_title(f"{mode_label(int(nolls[mode]))} [nm]", loc="left", pad=2)
            row[0].locator_params(axis="y", nbins=4)
            if spectra:
                segment = min(len(frames), SEGMENT)
                hann = np.hanning(segment + 1)[:-1]
                psd = mlab.psd(frames[:, mode], segment, rate_hz, "mean", hann, segment // 2)
                power, hertz = (np.asarray(one)[1:] for one in psd)
                row[1].plot(hertz, power, color=BLUE, linewidth=0.9)
                row[1].set_xscale("log")
                row[1].xaxis.set_major_formatter(power_of_ten)
                log_y(row[1], power, small=True)
                row[1].set_title("power [nm²/Hz]", loc="left", pad=2)
        for axes, label in zip(grid[-1], (x_label, "frequency [Hz]"), strict=False):
            axes.set_xlabel(label)

    caption = "Left: frame by frame; orange: adopted value. Right: power spectrum, by the frame rate."
    title = "Largest modes in time"
    return figure("cal-time", (1.4 * WIDTH_IN, 0.5 + 0.9 * len(largest)), draw, title, caption)


def _tables(of: Calibration) -> Stack:
    """Set-ups, effects, recordings and methods, as far as there are several."""
    results = of.results
    setups = Table.of(
        results.setups,
        {
            "recording": lambda one: one.name,
            "known defocus [nm]": lambda one: number(one.introduced_nm, "+.1f"),
            "frames": lambda one: number(one.frames, "d"),
            "χ²/ν": lambda one: number(one.chi2_nu, ".2f"),
            "wants more [nm]": lambda one: with_error(one.focus_nm, one.focus_sigma_nm, "+.1f"),
        },
        "Set-ups fitted together",
        "Wants more: defocus beyond the known and the common one by which its image alone would fit better.",
    )
    fitted = effects_table("Estimated with the NCPAs", results.effects, results.effects_sigma, EFFECTS)
    cubes = Table.of(
        results.cubes,
        {
            "recording": lambda cube: cube.name,
            "derotator [°]": lambda cube: number(cube.derotator_angle_deg, "g"),
            HIGHER: lambda cube: with_error(cube.higher_nm, cube.higher_sigma_nm),
            "defocus [nm]": lambda cube: number(cube.zernike_nm.get(4), "+.1f"),
            "χ²/ν": lambda cube: number(cube.chi2_nu, ".2f"),
            "frames": lambda cube: number(cube.frames, "d"),
        },
        "Recordings one by one",
    )
    estimates: list[Estimate] = [results, *results.compare]
    methods = Table.of(
        estimates if results.compare else [],
        {
            "method": lambda one: one.method,
            HIGHER: lambda one: number(one.higher_nm),
            "defocus [nm]": lambda one: number(one.zernike_nm.get(4), "+.1f"),
            "χ²/ν": lambda one: number(one.chi2_nu, ".2f"),
            "modes": lambda one: number(one.modes_estimated, "d"),
            "loss, optimiser": lambda one: f"{one.loss}, {one.optimiser}",
            "converged": lambda one: f"{one.status.get('converged', 0)} of {sum(one.status.values())}",
            "time [s]": lambda one: number(one.seconds),
        },
        "Methods",
    )
    return Stack(shown(setups, fitted, cubes, methods))


# -- correction --------------------------------------------------------------------------------


def correct_section(run: RunData) -> Section:
    of = run.of(CorrectResults)
    results, files = of.results, ", ".join(provenance_of(run.products[of.stage]).files)
    lead = f"{advice(run)}{f' Offsets in {files}.' if files else ''}"
    blocks = of.blocks(
        _predicted,
        _predicted_profile,
        partial(otf_figure, name="correct-otf", looks=PREDICTED),
        lambda of: energy_figure(of, "correct-energy", PREDICTED, ENERGY, results.resolution_mas),
        _budget,
        _offsets,
        _mirror,
    )
    return Section(of.stage, "Correction", lead, blocks, bad=not applicable(run))


def _predicted(of: Correction) -> list[Figure]:
    images = {"before": of["before"], "after": of["after"]}
    scale, mas = log_scale(*images.values()), of.pixel_scale_mas
    return [
        Figure(
            image_panel(f"psf-{when}", image, scale, mas, "part of the flux per pixel"),
            f"{when.capitalize()} correction",
            "Prediction without diversity and noise; same scale.",
            "third",
        )
        for when, image in images.items()
    ]


def _predicted_profile(of: Correction) -> Figure:
    looks = {"before": (ORANGE, "--"), "after": (BLUE, "-")}
    curves = {when: (of["radius_mas"], of[f"profile_{when}"], *look) for when, look in looks.items()}
    drawing = profile_plot("psf-profile", curves, ("mas", "part of the flux per pixel"), PANEL_IN)
    return Figure(drawing, "Radial profile", "Predicted; rings about the optical axis.", "third")


def _budget(of: Correction) -> Table:
    """What every part of the model takes of the Strehl ratio."""
    return Table.of(
        enumerate(of.results.strehl_budget),
        {
            "part of the model": lambda one: effect_link(one[1].name),
            "RMS of its modes [nm]": lambda one: number(one[1].wfe_nm, ".1f"),
            "Strehl with nothing else": lambda one: number(one[1].alone, ".3f"),
            "Strehl without it": lambda one: number(one[1].without, ".3f") if one[0] else MISSING,
        },
        "Strehl budget before correction",
        BUDGET,
        name="correct-budget",
    )


def _offsets(of: Correction) -> list[Block]:
    nolls, offsets, sigma = of["noll"].astype(int), of["offset_nm"], of.error_of("offset_nm")
    sigma = np.full(len(nolls), np.nan) if sigma is None else sigma
    rows = [
        (str(noll), mode_name(noll), number(offset, "+.2f"), number(error, ".2f"))
        for noll, offset, error in zip(nolls.tolist(), offsets, sigma, strict=True)
    ]
    columns = ("Noll", "mode", "offset [nm]", "1σ [nm]")
    parts = [rows[start : start + ROWS_PER_TABLE] for start in range(0, len(rows), ROWS_PER_TABLE)]
    return [
        *(Table(columns, part, f"Modal offsets, Noll {part[0][0]}–{part[-1][0]}") for part in parts),
        Text(f"{of.results.sign}. {MISSING} as error: mode not estimated, offset 0."),
    ]


def _mirror(of: Correction) -> Figure | None:
    """Offsets of a mirror's modes, and what they cannot make."""
    row, offsets = of.results.mirror, of["mirror_offset"]
    if row is None:
        return None

    def draw(axes: Axes) -> None:
        axes.errorbar(range(len(offsets)), offsets, of.error_of("mirror_offset"), fmt=".", color=BLUE)
        axes.axhline(0, color=ORANGE, linewidth=0.8)

    caption = (
        f"Of {number(row.before_nm, '.1f')} nm RMS over the clear pupil, without piston, tip and tilt, these "
        f"modes cannot make {number(row.after_nm, '.1f')} nm. The values are in mirror.csv and mirror.fits."
    )
    labels = ("mode of the mirror", "offset [unit of the table]")
    title = "Offsets of the mirror's modes"
    return plot("mirror-offsets", draw, labels, title, caption, "half", (5.2, 2.75))
