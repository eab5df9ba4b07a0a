"""Draw the figure of README.md: ``python docs/images/sample_reduction.py RUN``.

RUN is the run folder that ``make demo`` writes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from irlos_pipe.conventions.modes import REPORTED_NOLLS, REPORTED_TEXT
from irlos_pipe.product.storage import read_product
from irlos_pipe.report.drawing import BLUE, INK, ORANGE, STYLE
from irlos_pipe.report.images import BRIGHTNESS, SIGMA_LIMIT, SIGNED, brightness_scale, symmetric_scale

FIGURE = Path(__file__).with_suffix(".png")
TRUTH = Path(__file__).parents[2] / "data_samples" / "truth" / "calibration-sky.json"
SIZE_IN, DPI = (9.0, 5.6), 110


def draw_images(columns: list[Axes], run: Path) -> None:
    """Draw the mean image of the calibration cube, its model, and their difference in σ."""
    arrays = read_product(run / "03_calibrate.h5").arrays
    mean, model = arrays["mean_image_e"], arrays["model_image_e"].value
    sigma = np.where(mean.error > 0, mean.error, np.nan)
    scale = brightness_scale(mean.value, model)
    panels = {
        "measured": (mean.value, scale, BRIGHTNESS),
        "model": (model, scale, BRIGHTNESS),
        f"residual, ±{SIGMA_LIMIT:g}σ": ((mean.value - model) / sigma, symmetric_scale(SIGMA_LIMIT), SIGNED),
    }
    for axes, (title, (image, norm, colours)) in zip(columns, panels.items(), strict=True):
        axes.imshow(image, norm=norm, cmap=colours, origin="lower", interpolation="none")
        axes.set(title=title, xticks=[], yticks=[])
        axes.grid(False)


def draw_ncpas(axes: Axes, calibrate: dict) -> None:
    """Draw the estimated coefficients as bars and the true ones as dots."""
    nolls = list(REPORTED_NOLLS)
    true_nm = json.loads(TRUTH.read_text())["mean_zernike_nm"]
    estimate, sigma = ([calibrate[key][str(noll)] for noll in nolls] for key in ("zernike_nm", "sigma_nm"))
    axes.bar(nolls, estimate, color=BLUE, yerr=sigma, error_kw={"elinewidth": 0.9}, label="estimate, ±1σ")
    axes.plot(nolls, [true_nm[str(noll)] for noll in nolls], "o", color=ORANGE, markersize=3.5, label="truth")
    axes.set(title=f"NCPAs, {REPORTED_TEXT}", xlabel="Noll index", ylabel="coefficient [nm RMS]")
    axes.legend()


def draw_ramp(axes: Axes, points: list[dict]) -> None:
    """Draw the estimated against the introduced defocus."""
    introduced, defocus = (np.array([one[key] for one in points]) for key in ("introduced_nm", "defocus_nm"))
    axes.axline((0, 0), slope=1, color=INK, linewidth=0.9, label="1:1")
    axes.plot(introduced, defocus, "o", color=BLUE, markersize=4, label="frames")
    axes.set(title="focus ramp", xlabel="introduced defocus [nm RMS]", ylabel="estimated defocus [nm RMS]")
    axes.legend()


def main(run: Path) -> None:
    """Draw the run."""
    stages = json.loads((run / "results.json").read_text())["stages"]
    with matplotlib.rc_context(STYLE | {"figure.facecolor": "white"}):
        figure = Figure(figsize=SIZE_IN)
        top, bottom = figure.subfigures(2, height_ratios=(1, 0.95))
        draw_images(list(top.subplots(1, 3)), run)
        left, right = bottom.subplots(1, 2, width_ratios=(1.7, 1))
        draw_ncpas(left, stages["calibrate"])
        draw_ramp(right, stages["lift"]["points"])
        figure.savefig(FIGURE, dpi=DPI, metadata={"Software": None})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
