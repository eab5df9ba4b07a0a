"""Section on the correction: predicted image before and after, and the offsets."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure as Canvas

from irlos_pipe.product.results import provenance_of
from irlos_pipe.report.content import Figure, Section, Table, Text
from irlos_pipe.report.drawing import BLUE, ORANGE, svg
from irlos_pipe.report.images import PANEL_IN, image_panel, log_scale
from irlos_pipe.report.quality_plots import PREDICTED, energy_figures, otf_figures
from irlos_pipe.report.radial import profile_plot
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, mode_name, number
from irlos_pipe.stages.correct import CorrectResults, MirrorRow

STAGE = "correct"
ROWS_PER_TABLE = 10
OFFSET_COLUMNS = ("Noll", "mode", "offset [nm]", "1σ [nm]")
IMAGES = {"before": "Before", "after": "After"}
BUDGET_COLUMNS = ("part of the model", "RMS [nm]", "Strehl with nothing else", "Strehl without it")
BUDGET = (
    "Predicted with the effects as estimated, without diversity: brightest pixel over that of the image "
    "without aberrations. Small parts multiply; larger ones interfere, and the product is not that of all."
)
ENERGY = "Part of all light within a circle about the optical axis, predicted without diversity."


def correct_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(CorrectResults)
    blocks = [
        *_images(run),
        *_profile(run),
        *otf_figures(run, STAGE, "correct-otf", PREDICTED),
        *energy_figures(run, STAGE, "correct-energy", PREDICTED, ENERGY, results.resolution_mas),
        *_budget(results),
        *_offsets(run, results.sign),
        *_mirror(run, results.mirror),
    ]
    return Section(STAGE, "Correction", _lead(run, results), blocks)


def _lead(run: RunData, results: CorrectResults) -> str:
    files = ", ".join(provenance_of(run.products[STAGE]).files)
    return (
        f"Predicted Strehl {number(results.strehl_before, '.3f')} → "
        f"{number(results.strehl_after, '.3f')}{f'; offsets in {files}' if files else ''}."
    )


def _images(run: RunData) -> list[Figure]:
    stored = {name: run.array(STAGE, name) for name in IMAGES}
    images = {name: image for name, image in stored.items() if image is not None}
    if len(images) < len(IMAGES):
        return []
    scale = log_scale(*images.values())
    return [
        Figure(
            image_panel(
                f"psf-{name}", image, scale, run.pixel_scale_mas(STAGE), "part of the flux per pixel"
            ),
            f"{IMAGES[name]} correction",
            "Prediction without diversity and noise; same scale.",
            "third",
        )
        for name, image in images.items()
    ]


def _profile(run: RunData) -> list[Figure]:
    radius = run.array(STAGE, "radius_mas")
    stored = {name: run.array(STAGE, f"profile_{name}") for name in IMAGES}
    profiles = {name: profile for name, profile in stored.items() if profile is not None}
    if radius is None or len(profiles) < len(IMAGES):
        return []
    looks = {"before": (ORANGE, "--"), "after": (BLUE, "-")}
    curves = {name: (radius, profile, *looks[name]) for name, profile in profiles.items()}
    return [
        Figure(
            profile_plot("psf-profile", curves, ("mas", "part of the flux per pixel"), PANEL_IN),
            "Radial profile",
            "Predicted; rings about the optical axis.",
            "third",
        )
    ]


def _budget(results: CorrectResults) -> list[Table]:
    """What every part of the model takes of the Strehl ratio."""
    rows = [
        (
            one.name,
            number(one.wfe_nm, ".1f"),
            number(one.alone, ".3f"),
            number(one.without, ".3f") if place else MISSING,
        )
        for place, one in enumerate(results.strehl_budget)
    ]
    return [Table(BUDGET_COLUMNS, rows, "Strehl budget before correction", BUDGET)] if rows else []


def _offsets(run: RunData, sign: str) -> list[Table | Text]:
    nolls, offsets = run.array(STAGE, "noll"), run.array(STAGE, "offset_nm")
    if nolls is None or offsets is None:
        return []
    sigma = run.error_of(STAGE, "offset_nm")
    sigma = np.full(len(nolls), np.nan) if sigma is None else sigma
    rows = [
        (str(int(noll)), mode_name(int(noll)), number(offset, "+.2f"), number(error, ".2f"))
        for noll, offset, error in zip(nolls, offsets, sigma, strict=True)
    ]
    parts = [rows[start : start + ROWS_PER_TABLE] for start in range(0, len(rows), ROWS_PER_TABLE)]
    tables = [
        Table(OFFSET_COLUMNS, part, f"Modal offsets, Noll {part[0][0]}–{part[-1][0]}") for part in parts
    ]
    return [*tables, Text(f"{sign}. {MISSING} as error: mode not estimated, offset 0.")]


def _mirror(run: RunData, row: MirrorRow | None) -> list[Figure]:
    """Offsets of a mirror's modes, and what they cannot make."""
    offsets = run.array(STAGE, "mirror_offset")
    if row is None or offsets is None:
        return []

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.errorbar(range(len(offsets)), offsets, run.error_of(STAGE, "mirror_offset"), fmt=".", color=BLUE)
        axes.axhline(0, color=ORANGE, linewidth=0.8)
        axes.set(xlabel="mode of the mirror", ylabel="offset [unit of the table]")

    caption = (
        f"Of {number(row.before_nm, '.1f')} nm RMS over the clear pupil, without piston, tip and tilt, these "
        f"modes cannot make {number(row.after_nm, '.1f')} nm. The values are in mirror.csv and mirror.fits."
    )
    return [
        Figure(svg("mirror-offsets", (5.2, 2.75), draw), "Offsets of the mirror's modes", caption, "half")
    ]
