"""Draw the figures of docs/measured.md: ``python docs/images/measured.py RUNS``.

RUNS is the folder that ``make measured`` writes. Only differences from the models are drawn: the recordings
are not a part of the project.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from irlos_pipe.product.storage import read_product
from irlos_pipe.report.drawing import STYLE
from irlos_pipe.report.images import SIGNED, symmetric_scale

HERE, DPI, PANEL_IN = Path(__file__).parent, 100, (2.9, 2.6)
PERCENTILE = 99.5  # of the first residual of a figure, for the scale of all
NEAR_PX = 24  # half of the square about the peak that is shown of a large window


def draw(name: str, residuals: dict[str, np.ndarray], pixel_scale_mas: float) -> None:
    """Draw `residuals` in per cent of the peak, by title, on one scale, into the figure `name`."""
    scale = symmetric_scale(float(np.percentile(np.abs(next(iter(residuals.values()))), PERCENTILE)))
    width_in, height_in = PANEL_IN
    with matplotlib.rc_context():
        matplotlib.rcParams.update({**STYLE, "figure.facecolor": "white"})
        figure = Figure(figsize=(width_in * len(residuals) + 0.4, height_in))
        columns = figure.subplots(1, len(residuals), squeeze=False)[0]
        for axes, (title, image) in zip(columns, residuals.items(), strict=True):
            shown = panel(axes, title, image, scale, pixel_scale_mas)
        figure.colorbar(shown, ax=list(columns), label="% of the peak")
        figure.savefig(HERE / f"{name}.png", dpi=DPI)


def panel(axes: Axes, title: str, image: np.ndarray, scale, pixel_scale_mas: float):
    """Draw one residual about the middle of its window."""
    half_y, half_x = (side * pixel_scale_mas / 2 for side in image.shape)
    axes.set(title=title, xlabel="x [mas]")
    axes.grid(False)
    extent = (-half_x, half_x, -half_y, half_y)
    return axes.imshow(image, norm=scale, cmap=SIGNED, origin="lower", interpolation="none", extent=extent)


def draw_pharo(run: Path) -> None:
    """Mean of the held-out frames minus the model as it was, and minus that with what was found."""
    arrays = read_product(run / "02_diagnose.h5").arrays
    measured, before, after = (arrays[f"{name}_e"].value for name in ("measured", "before", "after"))
    percent = 100 / measured.max()
    draw(
        "measured_pharo",
        {"before": (measured - before) * percent, "after": (measured - after) * percent},
        25.0,
    )


def draw_nirc2(run: Path) -> None:
    """The image minus its model, near the peak."""
    arrays = read_product(run / "02_calibrate.h5").arrays
    image, model = (arrays[name].value for name in ("mean_image_e", "model_image_e"))
    row, column = np.unravel_index(image.argmax(), image.shape)
    near = np.s_[row - NEAR_PX : row + NEAR_PX + 1, column - NEAR_PX : column + NEAR_PX + 1]
    draw("measured_nirc2", {"measured − model": (image - model)[near] * 100 / image.max()}, 9.942)


def main(runs: str) -> None:
    """Draw what there is."""
    for name, drawing in {"pharo": draw_pharo, "nirc2": draw_nirc2}.items():
        if (Path(runs) / name).is_dir():
            drawing(Path(runs) / name)


if __name__ == "__main__":
    main(*sys.argv[1:])
