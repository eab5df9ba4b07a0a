"""Section on what the model lacked: images before and after, gap, names, what is left, limits."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.effects.public_values import rows_of
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table, Text
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE, svg
from irlos_pipe.report.images import (
    PANEL_IN,
    SIGNED,
    brightness_scale,
    image_panel,
    panel_axes,
    symmetric_scale,
)
from irlos_pipe.report.radial import star_profile
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_diagnose_names import ranking_figures, separation_tables, step_tables
from irlos_pipe.report.section_diagnose_rest import grade_texts, rest_blocks
from irlos_pipe.report.section_diagnose_sharing import sharing_tables
from irlos_pipe.report.text import is_known, number, with_error
from irlos_pipe.stages.diagnose.results import DiagnoseResults, GapRow

STAGE = "diagnose"
BRIGHTNESS_UNIT = "e⁻ (asinh scale)"
FINE = (
    "Finer than the telescope can make: {ratio} times what noise leaves there ({sigma} σ). More comes from "
    "the pixels: flat, offsets, response."
)
GAP_IN = (3.7, 2.85)
MAP_PERCENTILE = 99.5
PERCENTILE = 99.5  # of the residual before, for the common scale of the residuals
HELD_OUT = "Mean of the held-out frames; of all frames where pixels were held out."


def diagnose_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(DiagnoseResults)
    blocks: list[Block] = [
        *_images(run),
        *_leading(run),
        *_pupil(run),
        *_gap(results.gap),
        *_stacked(*_profile(run), *ranking_figures(results)),
        *grade_texts(results),
        *step_tables(results),
        *sharing_tables(results),
        *separation_tables(results),
        *_stacked(*rest_blocks(run, results)),
        *_modes(results),
        *_limits(results),
    ]
    return Section(STAGE, "What the model lacks", results.sentence, blocks)


def _stacked(*blocks: Figure | Table | Text) -> list[Stack]:
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
        figures += [Figure(panel, title, HELD_OUT, "third") for title, panel in panels.items()]
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
    images = {
        "measured": (measured, INK, "o"),
        "|residual| before": (np.abs(measured - before), ORANGE, "-"),
        "|residual| after": (np.abs(measured - after), BLUE, "-"),
        "1σ noise": (measured * np.nan if sigma is None else sigma, GREEN, "--"),
    }
    plot = star_profile("dia-profile", images, after, run.pixel_scale_mas(STAGE))
    return [Figure(plot, "Radial profile", f"About the star's centroid. {HELD_OUT}", "full")]


# -- numbers -----------------------------------------------------------------------------------


def _gap(gap: GapRow) -> list[Figure]:
    if not is_known(gap.before):
        return []
    shrink = number(gap.shrink, ".2f")
    caption = (
        f"Σ|measured − predicted| / Σ measured of frames or pixels that no fit has seen; shrink {shrink}."
    )
    return [Figure(gap_bars("dia-gap", gap), "Gap", caption, "third")]


def _modes(results: DiagnoseResults) -> list[Table]:
    before, after, sigma = results.zernike_nm.before, results.zernike_nm.after, results.sigma_nm
    both = [noll for noll in after if noll in before]
    rows = [
        (str(noll), number(before[noll], "+.1f"), with_error(after[noll], sigma.get(noll), "+.1f"))
        for noll in both
    ]
    if not any(abs(after[noll] - before[noll]) > 1e-6 for noll in both):
        return []
    columns = ("Noll", "before [nm]", "after [nm]")
    return [Table(columns, rows, "NCPAs with the old and with the new model", folded=True)]


def _limits(results: DiagnoseResults) -> list[Table | Text]:
    rows = [
        (name, ", ".join(f"{key} {number(value, '.2g')}" for key, value in rows_of(public)))
        for name, public in results.mdb.items()
    ]
    table = Table(("effect", "smallest size that would have been seen"), rows, "Not seen", folded=True)
    hidden = [(name, *_second(results, name)) for name in results.untestable]
    columns = ("effect", "second recording that shows it", "smallest size seen then")
    untestable = Table(columns, hidden, "Untestable with these free parameters")
    texts = [Text(f"Noise: {results.noise.text}.")] if results.noise else []
    if results.fine_structure:
        ratio = number(results.fine_structure.ratio, ".2f")
        sigma = number(results.fine_structure.significance, ".1f")
        texts.append(Text(FINE.format(ratio=ratio, sigma=sigma)))
    return [*([table] if rows else []), *([untestable] if hidden else []), *texts]


def _second(results: DiagnoseResults, name: str) -> tuple[str, str]:
    """The recording to take, and what it would show."""
    advice = results.second_recording.get(name)
    if advice is None:
        return "none of those tried", "–"
    sizes = ", ".join(f"{key} {number(value, '.2g')}" for key, value in rows_of(advice.smallest))
    return advice.recording, sizes


# -- drawings ----------------------------------------------------------------------------------


def gap_bars(name: str, gap: GapRow) -> Markup:
    """Draw the `gap` before and after against its floor; `name` is unique in the page."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.bar(["before", "after"], [gap.before, gap.after], 0.6, color=[ORANGE, BLUE])
        axes.axhline(gap.floor, color=INK, linestyle="--", linewidth=0.9, label="noise alone")
        axes.set(ylabel="gap, part of the light", ylim=(0, None))
        axes.grid(axis="x", visible=False)
        axes.legend()

    return svg(name, GAP_IN, draw)


def pupil_map(name: str, values: np.ndarray, unit: str) -> Markup:
    """Draw a map of the pupil about zero.

    Parameters
    ----------
    name : str
        Unique in the page.
    values : ndarray, (samples, samples)
    unit : str
        Label of the colour bar.
    """
    shown = np.where(values == 0, np.nan, values)
    limit = float(np.nanpercentile(np.abs(shown), MAP_PERCENTILE))

    def draw(figure: Canvas) -> None:
        axes, bar = panel_axes(figure)
        image = axes.imshow(
            shown, norm=symmetric_scale(limit), cmap=SIGNED, origin="lower", interpolation="none"
        )
        axes.set(xticks=[], yticks=[])
        figure.colorbar(image, cax=bar, label=unit)

    return svg(name, PANEL_IN, draw)
