"""Section on the correction: predicted image before and after, and the offsets."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes

from irlos_pipe.product.results import provenance_of
from irlos_pipe.report.content import Block, Figure, Section, Table, Text
from irlos_pipe.report.curves import PREDICTED, energy_figure, otf_figure, profile_plot
from irlos_pipe.report.drawing import BLUE, ORANGE, plot
from irlos_pipe.report.images import PANEL_IN, image_panel, log_scale
from irlos_pipe.report.run_data import RunData, StageData
from irlos_pipe.report.text import MISSING, mode_name, number
from irlos_pipe.stages.correct.stage import CorrectResults

ROWS_PER_TABLE = 10
BUDGET = (
    "Predicted with the effects as estimated, without diversity: brightest pixel over that of the image "
    "without aberrations. Small parts multiply; larger ones interfere, and the product is not that of all."
)
ENERGY = "Part of all light within a circle about the optical axis, predicted without diversity."
Correction = StageData[CorrectResults]


def correct_section(run: RunData) -> Section:
    """Build the section."""
    of = run.of(CorrectResults)
    results, files = of.results, ", ".join(provenance_of(run.products[of.stage]).files)
    lead = (
        f"Predicted Strehl {number(results.strehl_before, '.3f')} → "
        f"{number(results.strehl_after, '.3f')}{f'; offsets in {files}' if files else ''}."
    )
    blocks = of.blocks(
        _images,
        _profile,
        partial(otf_figure, name="correct-otf", looks=PREDICTED),
        lambda of: energy_figure(of, "correct-energy", PREDICTED, ENERGY, results.resolution_mas),
        _budget,
        _offsets,
        _mirror,
    )
    return Section(of.stage, "Correction", lead, blocks)


def _images(of: Correction) -> list[Figure]:
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


def _profile(of: Correction) -> Figure:
    looks = {"before": (ORANGE, "--"), "after": (BLUE, "-")}
    curves = {when: (of["radius_mas"], of[f"profile_{when}"], *look) for when, look in looks.items()}
    drawing = profile_plot("psf-profile", curves, ("mas", "part of the flux per pixel"), PANEL_IN)
    return Figure(drawing, "Radial profile", "Predicted; rings about the optical axis.", "third")


def _budget(of: Correction) -> Table:
    """What every part of the model takes of the Strehl ratio."""
    return Table.of(
        enumerate(of.results.strehl_budget),
        {
            "part of the model": lambda one: one[1].name,
            "RMS [nm]": lambda one: number(one[1].wfe_nm, ".1f"),
            "Strehl with nothing else": lambda one: number(one[1].alone, ".3f"),
            "Strehl without it": lambda one: number(one[1].without, ".3f") if one[0] else MISSING,
        },
        "Strehl budget before correction",
        BUDGET,
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
