"""Section on the calibration: images, NCPAs, wavefront, behaviour in time, methods side by side."""

from __future__ import annotations

from typing import Any

import numpy as np

from irlos_pipe.effects.telling import rows_of
from irlos_pipe.frames.detector import star_position
from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE
from irlos_pipe.report.images import SIGMA_LIMIT, SIGNED, brightness_scale, image_panel, symmetric_scale
from irlos_pipe.report.ncpa_plots import coefficient_bars, coefficients_in_time, wavefront_map
from irlos_pipe.report.radial import profile_plot, ring_means
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural, with_error

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
CUBE_COLUMNS = ("recording", "derotator [°]", "NCPA [nm RMS]", "defocus [nm]", "χ²/ν", "frames")


def calibrate_section(run: RunData) -> Section:
    """Build the section."""
    blocks = [
        *_images(run),
        *_bars(run),
        Stack([*_profile(run), *_maps(run)]),
        *_in_time(run),
        Stack([*_effects(run), *_cubes(run), *_methods(run)]),
    ]
    return Section(STAGE, "NCPA calibration", _lead(run), blocks)


def _lead(run: RunData) -> str:
    results = run.results(STAGE)
    names = ", ".join(recording.name for recording in run.recordings_of(STAGE))
    mean = "; every recording by itself, mean over them" if results.get("cubes") else ""
    return (
        f"{results.get('method', '')} on {plural(results.get('frames', 0), 'used frame')}"
        f"{f' of {names}' if names else ''}{mean}; diversity not included in the coefficients."
    )


def _images(run: RunData) -> list[Figure]:
    measured, model = run.array(STAGE, "mean_image_e"), run.array(STAGE, "model_image_e")
    if measured is None or model is None:
        return []
    scale, mas = brightness_scale(measured, model), run.pixel_scale_mas(STAGE)
    pictures = [
        image_panel("cal-measured", measured, scale, mas, BRIGHTNESS_UNIT, pixel_mask=_pixel_mask(run)),
        image_panel("cal-model", model, scale, mas, BRIGHTNESS_UNIT),
    ]
    return [
        Figure(pictures[0], "Measured", "Mean of the used frames; crosses: masked pixels.", "third"),
        Figure(pictures[1], "Model", "Same scale.", "third"),
        *_residual(run, measured - model),
    ]


def _residual(run: RunData, residual_e: np.ndarray) -> list[Figure]:
    sigma_e = run.error_of(STAGE, "mean_image_e")
    if sigma_e is None:
        return []
    image, scale = _in_sigma(residual_e, sigma_e, _pixel_mask(run)), symmetric_scale(SIGMA_LIMIT)
    panel = image_panel("cal-residual", image, scale, run.pixel_scale_mas(STAGE), "σ", SIGNED)
    return [Figure(panel, "Residual", f"Measured − model; χ²/ν {_chi2(run.results(STAGE))}.", "third")]


def _pixel_mask(run: RunData) -> np.ndarray | None:
    masks = [recording.pixel_mask for recording in run.recordings_of(STAGE)]
    return np.all(masks, axis=0) if masks and len({mask.shape for mask in masks}) == 1 else None


def _in_sigma(residual: np.ndarray, sigma: np.ndarray, good: np.ndarray | None) -> np.ndarray:
    usable = (sigma > 0) & (True if good is None else good)
    return np.divide(residual, sigma, out=np.full(residual.shape, np.nan), where=usable)


def _chi2(results: dict[str, Any]) -> str:
    return number(results.get("chi2_nu"), ".2f")


def _profile(run: RunData) -> list[Figure]:
    measured, model = run.array(STAGE, "mean_image_e"), run.array(STAGE, "model_image_e")
    if measured is None or model is None:
        return []
    mas, good, sigma = run.pixel_scale_mas(STAGE), _pixel_mask(run), run.error_of(STAGE, "mean_image_e")
    images = {
        "measured": (measured, INK, "o"),
        "model": (model, BLUE, "-"),
        "|residual|": (np.abs(measured - model), ORANGE, "-"),
    }
    if sigma is not None:
        images["1σ noise"] = (sigma, GREEN, "--")
    centre = star_position(np.nan_to_num(model))
    curves = {}
    for name, (image, colour, style) in images.items():
        radius, mean = ring_means(image if good is None else np.where(good, image, np.nan), centre)
        curves[name] = (radius * (mas or 1.0), mean, colour, style)
    return [
        Figure(
            profile_plot("cal-profile", curves, ("mas" if mas else "px", "mean of the ring [e⁻]")),
            "Radial profile",
            "About the star's centroid.",
            "full",
        )
    ]


def _bars(run: RunData) -> list[Figure]:
    results = run.results(STAGE)
    nolls = sorted(int(noll) for noll in results.get("zernike_nm", {}))
    if not nolls:
        return []
    others = {other["method"]: _by_noll(other, "zernike_nm", nolls) for other in results.get("compare", [])}
    bars = coefficient_bars(
        "cal-ncpa",
        nolls,
        _by_noll(results, "zernike_nm", nolls),
        _by_noll(results, "sigma_nm", nolls),
        others,
    )
    symbols = "; symbols: other methods" if others else ""
    return [Figure(bars, "NCPAs by Noll mode", f"Bars: {results.get('method')} with 1σ{symbols}.")]


def _by_noll(results: dict[str, Any], key: str, nolls: list[int]) -> np.ndarray:
    """Values in the order of `nolls`; NaN for modes that were not estimated."""
    return np.array([results.get(key, {}).get(str(noll)) for noll in nolls], dtype=float)


def _maps(run: RunData) -> list[Figure]:
    maps = {when: run.array("correct", f"wavefront_{when}_nm") for when in ("before", "after")}
    if any(opd is None or not np.isfinite(opd).any() for opd in maps.values()):
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


def _effects(run: RunData) -> list[Table]:
    effects = run.results(STAGE).get("effects") or {}
    rows = [
        ("" if place else effect, name, number(value, ".4g"))
        for effect, values in effects.items()
        for place, (name, value) in enumerate(rows_of(values))
    ]
    return [Table(("effect", "parameter", "value"), rows, "Estimated with the NCPAs")] if rows else []


def _cubes(run: RunData) -> list[Table]:
    rows = [
        (
            cube["name"],
            number(cube.get("derotator_angle_deg"), "g"),
            with_error(cube.get("wfe_nm"), cube.get("wfe_sigma_nm")),
            number(cube.get("zernike_nm", {}).get("4"), "+.1f"),
            _chi2(cube),
            number(cube.get("frames"), "d"),
        )
        for cube in run.results(STAGE).get("cubes", [])
    ]
    return [Table(CUBE_COLUMNS, rows, "Recordings one by one")] if rows else []


def _methods(run: RunData) -> list[Table]:
    results = run.results(STAGE)
    if not results.get("compare"):
        return []
    return [Table(METHOD_COLUMNS, [_method_row(one) for one in (results, *results["compare"])], "Methods")]


def _method_row(one: dict[str, Any]) -> tuple[str, ...]:
    fits = one.get("status", {})
    converged = f"{fits.get('converged', 0)} of {sum(fits.values())}"
    return (
        one["method"],
        number(one.get("wfe_nm")),
        number(one.get("zernike_nm", {}).get("4"), "+.1f"),
        _chi2(one),
        number(one.get("modes_estimated"), "d"),
        f"{one.get('loss', '')}, {one.get('optimiser', '')}",
        converged,
        number(one.get("seconds")),
    )
