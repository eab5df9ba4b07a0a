"""Radial profiles on a logarithmic axis: of a star, or of given curves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from irlos_pipe.frames.detector import star_position
from irlos_pipe.optics.azimuthal_mean import ring_means
from irlos_pipe.report.drawing import log_y, svg

SIZE_IN = (4.4, 3.2)


def star_profile(
    name: str,
    images: Mapping[str, tuple[np.ndarray, str, str]],
    model_e: np.ndarray,
    pixel_scale_mas: float | None,
) -> Markup:
    """Draw radial means about the centroid of a star.

    Parameters
    ----------
    name : str
        Unique in the page.
    images : mapping
        By label: image (rows, columns) [e-], NaN where it is not used, colour and line style.
    model_e : ndarray, (rows, columns)
        Model of the star, which gives the centroid.
    pixel_scale_mas : float or None
        None draws radii in pixels.
    """
    centre, curves = star_position(np.nan_to_num(model_e)), {}
    for label, (image, colour, style) in images.items():
        radius_px, mean = ring_means(image, centre)
        curves[label] = (radius_px * (pixel_scale_mas or 1.0), mean, colour, style)
    return profile_plot(name, curves, ("mas" if pixel_scale_mas else "px", "mean of the ring [e⁻]"))


def profile_plot(
    name: str,
    curves: Mapping[str, tuple[np.ndarray, np.ndarray, str, str]],
    units: tuple[str, str],
    size_in: tuple[float, float] = SIZE_IN,
) -> Markup:
    """Draw profiles; values that are not positive leave gaps.

    Parameters
    ----------
    name : str
        Unique in the page.
    curves : mapping
        By label: radius, values, colour and line style.
    units : tuple of str
        Unit of the radius, and label of the axis of the values.
    size_in : tuple of float
        Width and height [inch].
    """

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for label, (radius, values, colour, style) in curves.items():
            axes.plot(radius, np.where(values > 0, values, np.nan), style, color=colour, label=label)
        axes.set(xlabel=f"radius [{units[0]}]", ylabel=units[1])
        axes.set_xlim(left=0)
        log_y(axes, *(values for _, values, *_ in curves.values()))
        axes.legend()

    return svg(name, size_in, draw)
