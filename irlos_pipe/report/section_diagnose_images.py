"""Images of a diagnosis: measured, predicted and left before and after, what was added, and their curves."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.effects import CATALOGUE
from irlos_pipe.report.content import Block, Figure, Width
from irlos_pipe.report.drawing import BLUE, FAINT, GREEN, INK, ORANGE, svg
from irlos_pipe.report.image_views import image_views, residual_views
from irlos_pipe.report.images import PANEL_IN, SIGNED, image_panel, label_bar, panel_axes, symmetric_scale
from irlos_pipe.report.misfit_plots import quantile_figures
from irlos_pipe.report.quality_plots import DIAGNOSED, Look, energy_figures, otf_figures, power_figures
from irlos_pipe.report.radial import star_profile
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number
from irlos_pipe.stages.diagnose.results import DiagnoseResults

STAGE = "diagnose"
LEFT = {"_before": Look("before", ORANGE), "_after": Look("after", BLUE)}
MAP_PERCENTILE, NOTHING = 99.0, 1e-9
PERCENTILE = 99.5  # of the leading mode, for its scale
HELD_OUT = "Mean of the held-out frames; of all frames where pixels were held out."
LEADING = (
    "The pattern by which frames differ most from one another, beyond what the fitted parameters change, in "
    "standard errors of a frame. Noise alone gives speckles of some tenths; a pattern says what moves."
)


def picture_blocks(run: RunData) -> list[Block]:
    """Return images before and after, residuals, leading mode, and what was added in the pupil."""
    measured, before, after = (run.array(STAGE, name) for name in ("measured_e", "before_e", "after_e"))
    if measured is None or before is None or after is None:
        return []
    mas, sigma = run.pixel_scale_mas(STAGE), run.error_of(STAGE, "measured_e")
    images, residuals = {"Measured": (measured, HELD_OUT)}, {}
    models = {"": (after, "")}
    if not np.array_equal(before, after, equal_nan=True):
        models = {" before": (before, "By the model as it was."), " after": (after, "With what was found.")}
    for when, (model, caption) in models.items():
        images[f"Predicted{when}"] = (model, caption)
        residuals[f"Residual{when}"] = (measured - model, f"Measured − predicted. {caption}")
    width: Width = "two-thirds" if len(models) > 1 else "third"
    return [
        residual_views("dia-left", residuals, sigma, float(np.nanmax(after)), mas, width),
        *_leading(run),
        image_views("dia-images", images, mas),
    ]


def curve_figures(run: RunData) -> list[Figure]:
    """Return radial profile, power of the residual, OTF and encircled energy."""
    return [
        *_profile(run),
        *power_figures(run, STAGE, "dia-power", LEFT),
        *_quantiles(run),
        *otf_figures(run, STAGE, "dia-otf", DIAGNOSED),
        *energy_figures(run, STAGE, "dia-energy", DIAGNOSED, "Part of the light in the window."),
    ]


def _quantiles(run: RunData) -> list[Figure]:
    measured, sigma = run.array(STAGE, "measured_e"), run.error_of(STAGE, "measured_e")
    if measured is None or sigma is None:
        return []
    models = {look: run.array(STAGE, name.removeprefix("_") + "_e") for name, look in LEFT.items()}
    residuals = {
        look: np.divide(measured - model, sigma, out=np.full(measured.shape, np.nan), where=sigma > 0)
        for look, model in models.items()
        if model is not None
    }
    return quantile_figures("dia-quantiles", residuals)


def _leading(run: RunData) -> list[Figure]:
    mode = run.array(STAGE, "leading_mode")
    if mode is None:
        return []
    scale = symmetric_scale(float(np.nanpercentile(np.abs(mode), PERCENTILE)) or 1.0)
    panel = image_panel("dia-leading", mode, scale, run.pixel_scale_mas(STAGE), "σ", SIGNED)
    return [Figure(panel, "What varies most", LEADING, "third")]


def pupil_figures(run: RunData, results: DiagnoseResults) -> list[Figure]:
    """Return maps of the wavefront and the amplitude that were added by what was found."""
    opd, amplitude = (run.array(STAGE, name) for name in ("added_opd_nm", "added_amplitude"))
    found = []
    if opd is not None and np.nanmax(np.abs(opd), initial=0.0) > NOTHING:
        added = results.added_wavefront
        caption = (
            f"{number(added.rms_nm, '.0f', 'nm RMS')}, {number(added.pv_nm, '.0f', 'nm')} peak to valley "
            "over the clear pupil, x and y as in the images."
        )
        found.append(Figure(pupil_map("dia-opd", opd, "nm"), "Wavefront added", caption, "third"))
    if amplitude is not None and _dims(results) and np.abs(amplitude).max() > NOTHING:
        caption = "Change of the amplitude in the pupil, in % of what it is where the pupil is clear."
        panel = pupil_map("dia-amplitude", 100 * amplitude, "%", 100.0)
        found.append(Figure(panel, "Amplitude added", caption, "third"))
    return found


def _dims(results: DiagnoseResults) -> bool:
    """Whether any name changes the amplitude in the pupil; of a wavefront only its edges would show."""
    names = [step.effect for step in results.steps]
    kinds = [kind for kind in CATALOGUE.values() if any(name.startswith(kind.name) for name in names)]
    return any(kind.plane == "pupil" and not kind.aberration for kind in kinds)


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
    return [Figure(plot, "Radial profile", f"About the star's centroid. {HELD_OUT}", "third")]


def pupil_map(name: str, values: np.ndarray, unit: str, percentile: float = MAP_PERCENTILE) -> Markup:
    """Draw a map of the pupil about zero.

    Parameters
    ----------
    name : str
        Unique in the page.
    values : ndarray, (samples, samples)
        NaN where the pupil is dark.
    unit : str
        Label of the colour bar.
    percentile : float
        Of the absolute values, where colours end.
    """
    scale = symmetric_scale(float(np.nanpercentile(np.abs(values), percentile)))

    def draw(figure: Canvas) -> None:
        axes, bar = panel_axes(figure)
        image = axes.imshow(values, norm=scale, cmap=SIGNED, origin="lower", interpolation="none")
        axes.set_facecolor(FAINT)
        axes.set(xlabel="x →", ylabel="y →", xticks=[], yticks=[])
        figure.colorbar(image, cax=bar, label=unit, extend="both")
        label_bar(bar, scale)

    return svg(name, PANEL_IN, draw)
