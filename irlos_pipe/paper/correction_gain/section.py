"""Section on the star before and after the correction of simulated NCPAs."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.optics.azimuthal_mean import ring_means
from irlos_pipe.paper.common.section import array_of
from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE
from irlos_pipe.paper.correction_gain.results import CorrectionGainResults, SeeingRow
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE, svg
from irlos_pipe.report.images import BRIGHTNESS, SIGNED, log_scale, symmetric_scale
from irlos_pipe.report.radial import profile_plot
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number

STAGE = CorrectionGainResults.stage
STATES = {"before": "before", PAPER_CHOICE: "DIP global", DEFAULT: "this pipeline", "ideal": "no NCPAs"}
LOOKS = {"before": (ORANGE, "--"), PAPER_CHOICE: (GREEN, "-."), DEFAULT: (BLUE, "-"), "ideal": (INK, ":")}
WAVEFRONT_CAPTION = (
    "Time-averaged true wavefront, estimates, and what the estimates leave; tip and tilt included."
)

PROFILE_CAPTION = "Means in rings of one pixel."


def section(run: RunData) -> Section:
    """Build the section."""
    rows = run.results(CorrectionGainResults).seeings
    blocks: list[Block] = [_table(rows)]
    for row in rows:
        blocks += _figures(run, row.seeing_arcsec)
    return Section(STAGE, "Star before and after the correction", _lead(rows), blocks)


def _lead(rows: list[SeeingRow]) -> str:
    gains = [
        f'{row.strehl["before"]:.2f} → {row.strehl[DEFAULT]:.2f} at {row.seeing_arcsec:g}"' for row in rows
    ]
    return f"Median Strehl ratio at 1600 nm: {', '.join(gains)}. Without diversity; Noll 4–30 corrected."


def _table(rows: list[SeeingRow]) -> Table:
    body = [
        [
            f'{row.seeing_arcsec:g}"',
            *(number(row.strehl[state], ".3f") for state in STATES),
            number(row.won[PAPER_CHOICE], ".0%"),
            number(row.won[DEFAULT], ".0%"),
            str(row.samples),
        ]
        for row in rows
    ]
    columns = ("seeing", *STATES.values(), "won by DIP global", "won by this pipeline", "stars")
    caption = (
        "Peak of the averaged image over that of an aberration-free star, median. Won: part of the Strehl "
        "ratio that a correction of all modes would bring."
    )
    return Table(columns, body, "Strehl ratio", caption)


def _figures(run: RunData, seeing: float) -> list[Figure]:
    images = {state: array_of(run, STAGE, f"{seeing:g}/{state}/image") for state in STATES}
    pixel = _pixel(run, seeing)
    return [
        Figure(
            _stars(seeing, images, pixel), f'Averaged star at {seeing:g}"', "One logarithmic scale.", "full"
        ),
        Figure(_wavefronts(run, seeing), f'Wavefronts at {seeing:g}"', WAVEFRONT_CAPTION, "full"),
        Figure(_profiles(seeing, images, pixel), f'Radial profiles at {seeing:g}"', PROFILE_CAPTION),
    ]


def _pixel(run: RunData, seeing: float) -> tuple[float, str]:
    """Side of a pixel and its unit; products of version 1 do not state it."""
    scale_mas = run.array(STAGE, f"{seeing:g}/pixel_scale_mas")
    return (1.0, "px") if scale_mas is None else (float(scale_mas), "mas")


def _stars(seeing: float, images: dict[str, np.ndarray], pixel: tuple[float, str]) -> Markup:
    scale = log_scale(*images.values())

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(images))
        for axes, (state, image) in zip(panels, images.items(), strict=True):
            half = image.shape[1] / 2 * pixel[0]
            shown = axes.imshow(
                image, norm=scale, cmap=BRIGHTNESS, origin="lower", extent=(-half, half, -half, half)
            )
            axes.set(title=STATES[state], xlabel=f"x [{pixel[1]}]")
            axes.grid(False)
        panels[0].set_ylabel(f"y [{pixel[1]}]")
        figure.colorbar(shown, ax=panels, label="photons per pixel, part of all", shrink=0.75)

    return svg(f"gain-stars-{seeing:g}".replace(".", "-"), (9.5, 2.7), draw)


def _wavefronts(run: RunData, seeing: float) -> Markup:
    truth = array_of(run, STAGE, f"{seeing:g}/truth_nm")
    maps = {"true": truth}
    for variant in (PAPER_CHOICE, DEFAULT):
        estimate = array_of(run, STAGE, f"{seeing:g}/{variant}/wavefront_nm")
        maps |= {STATES[variant]: estimate, f"true − {STATES[variant]}": truth - estimate}
    scale = symmetric_scale(float(np.nanpercentile(np.abs(truth), 99)))

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(maps))
        for axes, (title, values) in zip(panels, maps.items(), strict=True):
            shown = axes.imshow(values - np.nanmean(values), norm=scale, cmap=SIGNED, origin="lower")
            axes.set(title=f"{title}\n{np.nanstd(values):.0f} nm RMS", xticks=[], yticks=[])
            axes.set_frame_on(False)
        figure.colorbar(shown, ax=panels, label="nm", shrink=0.75)

    return svg(f"gain-wavefronts-{seeing:g}".replace(".", "-"), (9.5, 2.4), draw)


def _profiles(seeing: float, images: dict[str, np.ndarray], pixel: tuple[float, str]) -> Markup:
    curves = {}
    for state, image in images.items():
        centre = tuple((side - 1) / 2 for side in image.shape)
        radius_px, mean = ring_means(image, centre)
        curves[STATES[state]] = (radius_px * pixel[0], mean, *LOOKS[state])
    return profile_plot(
        f"gain-profiles-{seeing:g}".replace(".", "-"), curves, (pixel[1], "photons per pixel, part of all")
    )
