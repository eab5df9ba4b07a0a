"""Section on what the model lacked: images before and after, gap, ranking of names, limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from irlos_pipe.effects.public_values import rows_of
from irlos_pipe.frames.detector import star_position
from irlos_pipe.optics.profile import ring_means
from irlos_pipe.report.content import Figure, Section, Stack, Table, Text
from irlos_pipe.report.diagnose_plots import gap_bars, pupil_map, ranking_bars
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE
from irlos_pipe.report.images import SIGNED, brightness_scale, image_panel, symmetric_scale
from irlos_pipe.report.radial import profile_plot
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, rounded_by_error, with_error

STAGE = "diagnose"
BRIGHTNESS_UNIT = "e⁻ (asinh scale)"
FINE = (
    "Finer than the telescope can make: {ratio} times what noise leaves there ({sigma} σ). More comes from "
    "the pixels: flat, offsets, response."
)
PERCENTILE = 99.5  # of the residual before, for the common scale of the residuals
STEP_COLUMNS = ("name", "parameter", "value", "significance", "explained", "not told apart from")


def diagnose_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    blocks = [
        *_images(run),
        *_leading(run),
        *_pupil(run),
        *_gap(results),
        *_stacked(*_profile(run), *_ranking(results)),
        *_stacked(*_steps(results), *_separation(results)),
        *_modes(results),
        *_limits(results),
    ]
    return Section(STAGE, "What the model lacks", str(results.get("sentence", "")), blocks)


def _stacked(*blocks: Figure | Table) -> list[Stack]:
    return [Stack(blocks)] if blocks else []


# -- images ------------------------------------------------------------------------------------


def _images(run: RunData) -> list[Figure]:
    """Measured, predicted and residual, before above after, each kind on one scale."""
    measured, before, after = (run.array(STAGE, name) for name in ("measured_e", "before_e", "after_e"))
    if measured is None or before is None or after is None:
        return []
    mas, bright = run.pixel_scale_mas(STAGE), brightness_scale(measured, before, after)
    signed = symmetric_scale(_limit(measured - before))
    figures = []
    for when, model in (("before", before), ("after", after)):
        panels = {
            "Measured": image_panel(f"dia-measured-{when}", measured, bright, mas, BRIGHTNESS_UNIT),
            f"Predicted {when}": image_panel(f"dia-model-{when}", model, bright, mas, BRIGHTNESS_UNIT),
            f"Residual {when}": image_panel(f"dia-left-{when}", measured - model, signed, mas, "e⁻", SIGNED),
        }
        figures += [
            Figure(panel, title, "Mean of the held-out frames.", "third") for title, panel in panels.items()
        ]
    return figures


def _limit(residual: np.ndarray) -> float:
    return float(np.nanpercentile(np.abs(residual), PERCENTILE)) or 1.0


def _leading(run: RunData) -> list[Figure]:
    mode = run.array(STAGE, "leading_mode")
    if mode is None:
        return []
    scale = symmetric_scale(_limit(mode))
    panel = image_panel("dia-leading", mode, scale, run.pixel_scale_mas(STAGE), "σ", SIGNED)
    return [Figure(panel, "What varies most", "Leading mode of the residual over the frames.", "third")]


def _pupil(run: RunData) -> list[Figure]:
    maps = {
        "dia-opd": ("added_opd_nm", "nm", "Wavefront added"),
        "dia-amplitude": ("added_amplitude", "of the clear pupil", "Amplitude added"),
    }
    found = []
    for name, (array, unit, title) in maps.items():
        added = run.array(STAGE, array)
        if added is not None and np.any(np.abs(added) > 1e-9):
            found.append(Figure(pupil_map(name, added, unit), title, "In the plane of the pupil.", "third"))
    return found


def _profile(run: RunData) -> list[Figure]:
    measured, before, after = (run.array(STAGE, name) for name in ("measured_e", "before_e", "after_e"))
    sigma = run.error_of(STAGE, "measured_e")
    if measured is None or before is None or after is None:
        return []
    mas = run.pixel_scale_mas(STAGE)
    centre = star_position(np.nan_to_num(after))
    images = {
        "measured": (measured, INK, "o"),
        "|residual| before": (np.abs(measured - before), ORANGE, "-"),
        "|residual| after": (np.abs(measured - after), BLUE, "-"),
        "1σ noise": (measured * np.nan if sigma is None else sigma, GREEN, "--"),
    }
    curves = {}
    for name, (image, colour, style) in images.items():
        radius, mean = ring_means(image, centre)
        curves[name] = (radius * (mas or 1.0), mean, colour, style)
    plot = profile_plot("dia-profile", curves, ("mas" if mas else "px", "mean of the ring [e⁻]"))
    return [Figure(plot, "Radial profile", "About the star's centroid, held-out frames.", "full")]


# -- numbers -----------------------------------------------------------------------------------


def _gap(results: Mapping[str, Any]) -> list[Figure]:
    gap = results.get("gap") or {}
    if gap.get("before") is None:
        return []
    shrink = number(gap.get("shrink"), ".2f")
    caption = f"Σ|measured − predicted| / Σ measured of frames that no fit has seen; shrink {shrink}."
    return [Figure(gap_bars("dia-gap", gap), "Gap", caption, "third")]


def _ranking(results: Mapping[str, Any]) -> list[Figure]:
    steps = [*results.get("steps", []), *filter(None, [results.get("nearest")])]
    ranking = [row for step in steps[:1] for row in step.get("ranking", [])]
    if not ranking:
        return []
    caption = "Part of the excess over noise that each name explains when fitted; significance in σ."
    return [Figure(ranking_bars("dia-ranking", ranking), "Candidates", caption, "full")]


def _steps(results: Mapping[str, Any]) -> list[Table]:
    steps = [*results.get("steps", []), *filter(None, [results.get("nearest")])]
    rows = [row for step in steps for row in _step_rows(step)]
    title = "Found" if results.get("steps") else "Nearest"
    return [Table(STEP_COLUMNS, rows, title)] if rows else []


def _step_rows(step: Mapping[str, Any]) -> list[tuple[str, ...]]:
    values, errors = rows_of(step["parameters"]), dict(rows_of(step["sigma"]))
    head = (number(step["significance"], ".1f", "σ"), number(step["explained"], ".0%"))
    others = ", ".join(step["indistinguishable"]) or "–"
    return [
        (
            step["effect"] if first else "",
            name,
            rounded_by_error(value, errors.get(name)) if isinstance(value, float) else str(value),
            *(head if first else ("", "")),
            others if first else "",
        )
        for first, (name, value) in zip([True] + [False] * len(values), values, strict=False)
    ]


def _separation(results: Mapping[str, Any]) -> list[Table]:
    rows = [
        (f"{step['effect']} or {other['name']}", other["reason"], _what_separates(other))
        for step in results.get("steps", [])
        for other in step.get("alternatives", [])
    ]
    return [Table(("names", "why", "what tells them apart"), rows, "Not told apart")] if rows else []


def _what_separates(other: Mapping[str, Any]) -> str:
    """What tells them apart, and the second recording in which they are least alike."""
    words = other.get("second_recording")
    cosine = number(other.get("likeness_then"), ".2f")
    return other["separated_by"] + (f"; a second recording {words} (|cos| then {cosine})" if words else "")


def _modes(results: Mapping[str, Any]) -> list[Table]:
    modes = results.get("zernike_nm") or {}
    before, after = modes.get("before", {}), modes.get("after", {})
    sigma = results.get("sigma_nm", {})
    rows = [
        (noll, number(before[noll], "+.1f"), with_error(after[noll], sigma.get(noll), "+.1f"))
        for noll in after
        if noll in before
    ]
    changed = [b - a for b, a in zip(before.values(), after.values(), strict=True) if None not in (a, b)]
    if not np.any(np.abs(changed) > 1e-6):
        return []
    columns = ("Noll", "before [nm]", "after [nm]")
    return [Table(columns, rows, "NCPAs with the old and with the new model", folded=True)]


def _limits(results: Mapping[str, Any]) -> list[Table | Text]:
    mdb = results.get("mdb") or {}
    rows = [
        (name, ", ".join(f"{key} {number(value, '.2g')}" for key, value in rows_of(public)))
        for name, public in mdb.items()
    ]
    table = Table(("effect", "smallest size that would have been seen"), rows, "Not seen", folded=True)
    hidden = [(name, *_second(results, name)) for name in results.get("untestable", [])]
    columns = ("effect", "second recording that shows it", "smallest size seen then")
    untestable = Table(columns, hidden, "Untestable with these free parameters")
    noise = (results.get("noise") or {}).get("text")
    told = [Text(f"Noise: {noise}.")] if noise else []
    fine = results.get("fine_structure")
    if fine:
        ratio, sigma = number(fine["ratio"], ".2f"), number(fine["significance"], ".1f")
        told.append(Text(FINE.format(ratio=ratio, sigma=sigma)))
    return [*([table] if rows else []), *([untestable] if hidden else []), *told]


def _second(results: Mapping[str, Any], name: str) -> tuple[str, str]:
    """The recording to take, and what it would show."""
    advice = (results.get("second_recording") or {}).get(name)
    if advice is None:
        return "none of those tried", "–"
    sizes = ", ".join(f"{key} {number(value, '.2g')}" for key, value in rows_of(advice["smallest"]))
    return advice["recording"], sizes
