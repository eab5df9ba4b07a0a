"""Detector images on mas axes, and thumbnails."""

from __future__ import annotations

import base64
import io
import math
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import EngFormatter, ScalarFormatter

from irlos_pipe.report.drawing import INK, own_style, svg

BRIGHTNESS = matplotlib.colormaps["inferno"].with_extremes(bad="#8d979f")
SIGNED = matplotlib.colormaps["RdBu_r"].with_extremes(bad="#8d979f00")
PANEL_IN = (3.7, 2.85)
# Where the image and its colour bar stand in a panel: left, bottom, width, height [inch].
IMAGE_BOX_IN = (0.65, 0.45, 2.3, 2.3)
BAR_BOX_IN = (3.03, 0.45, 0.1, 2.3)
SIGMA_LIMIT = 5.0
DECADES = 4.0
# The asinh scale turns linear below this part of the peak.
LINEAR_PART = 3e-3
MANY_DIGITS = 1e4  # from which numbers are written as 12k
TICK_ROOM = 0.07  # part of a colour bar, that a label needs


class Ring(NamedTuple):
    """A ring that marks a place: middle from the centre of the window and diameter, in units of the axes."""

    x: float
    y: float
    diameter: float


def brightness_scale(*images: np.ndarray) -> Normalize:
    """One asinh scale for several images: linear near zero, logarithmic above."""
    low, high = _range(*images)
    return AsinhNorm(linear_width=LINEAR_PART * max(abs(low), abs(high)), vmin=min(low, 0.0), vmax=high)


def log_scale(*images: np.ndarray) -> Normalize:
    """One logarithmic scale over four decades below the peak."""
    high = _range(*images)[1]
    return LogNorm(high * 10**-DECADES, high, clip=True)


def linear_scale(*images: np.ndarray) -> Normalize:
    """One linear scale for several images."""
    low, high = _range(*images)
    return Normalize(min(low, 0.0), high)


def symmetric_scale(limit: float, linear_width: float | None = None) -> Normalize:
    """Return a scale about zero, linear or asinh.

    Parameters
    ----------
    limit : float
        Of either end.
    linear_width : float, optional
        Within which an asinh scale is linear; it is logarithmic beyond.
    """
    if linear_width is None:
        return Normalize(-limit, limit)
    return AsinhNorm(linear_width, -limit, limit)


def image_panel(
    name: str,
    image: np.ndarray,
    scale: Normalize,
    pixel_scale_mas: float | None,
    unit: str,
    colours: matplotlib.colors.Colormap = BRIGHTNESS,
    good: np.ndarray | None = None,
    ring: Ring | None = None,
) -> Markup:
    """Draw an image with its colour bar; axes in mas (px without a scale) from the centre of the window.

    Parameters
    ----------
    name : str
        Identifies the drawing on the page.
    image : ndarray, (rows, columns)
        Row 0 is at the bottom.
    scale : Normalize
        From values to colours.
    pixel_scale_mas : float or None
        Side of a pixel [mas].
    unit : str
        Unit of the image.
    colours : Colormap
        Of the image.
    good : ndarray of bool, optional
        Pixels that are False were not used and get a cross.
    ring : Ring, optional
        Drawn about a place.
    """
    step, axis_unit = (pixel_scale_mas, "mas") if pixel_scale_mas else (1.0, "px")

    def draw(figure: Figure) -> None:
        axes, bar = panel_axes(figure)
        shown = axes.imshow(
            image,
            norm=scale,
            cmap=colours,
            origin="lower",
            interpolation="none",
            extent=_extent(image.shape, step),
        )
        axes.set(xlabel=f"x [{axis_unit}]", ylabel=f"y [{axis_unit}]")
        _cross_out(axes, good, step)
        if ring:
            axes.add_patch(Circle((ring.x, ring.y), ring.diameter / 2, fill=False, color=INK, linestyle="--"))
        figure.colorbar(shown, cax=bar, label=unit)
        label_bar(bar, scale)

    return svg(name, PANEL_IN, draw)


def label_bar(bar: Axes, scale: Normalize) -> None:
    """Give a colour bar numbers that are short enough to leave the unit its place and do not overlap.

    Parameters
    ----------
    bar : Axes
    scale : Normalize
        Of its image.
    """
    bar.minorticks_off()
    if isinstance(scale, AsinhNorm):
        ticks = asinh_ticks(scale)
        bar.set_yticks(ticks, [_short(tick) for tick in ticks])
    elif isinstance(bar.yaxis.get_major_formatter(), ScalarFormatter):
        largest = max(abs(scale.vmin or 0.0), abs(scale.vmax or 0.0))
        short: Any = EngFormatter(sep="") if largest >= MANY_DIGITS else _short_number
        bar.yaxis.set_major_formatter(short)


def asinh_ticks(scale: AsinhNorm) -> list[float]:
    """Return zero, powers of ten, and three times these within an asinh scale, as far as labels have room."""
    low, high, width = scale.vmin or 0.0, scale.vmax or 1.0, scale.linear_width
    last = math.floor(math.log10(max(abs(low), abs(high))))
    powers = [sign * 10.0**power for power in range(last, last - 9, -1) for sign in (1, -1)]
    wanted = np.array([0.0, *powers, *(3 * power for power in powers)])
    wanted = wanted[(low <= wanted) & (wanted <= high) & ((abs(wanted) > width / 10) | (wanted == 0))]
    found: dict[float, float] = {}
    for tick, place in zip(wanted.tolist(), np.asarray(scale(wanted)).tolist(), strict=True):
        if all(abs(place - other) > TICK_ROOM for other in found.values()):
            found[tick] = place
    return sorted(found)


def _short_number(value: float, _: int | None = None) -> str:
    return f"{value:.6g}".replace("-", "−")


def _short(value: float) -> str:
    """A tick of an asinh scale, written out where that is short."""
    if value == 0 or 1e-2 <= abs(value) < MANY_DIGITS:
        return _short_number(value)
    power = math.floor(math.log10(abs(value)) + 1e-9)
    factor = round(abs(value) / 10**power)
    return f"{'−' if value < 0 else ''}{'' if factor == 1 else f'{factor}·'}$10^{{{power}}}$"


def panel_axes(figure: Figure) -> tuple[Axes, Axes]:
    """Add axes for a square image and for a colour bar of the same height."""
    figure.set_layout_engine("none")
    width, height = figure.get_size_inches()
    image, bar = (
        figure.add_axes((left / width, bottom / height, across / width, up / height))
        for left, bottom, across, up in (IMAGE_BOX_IN, BAR_BOX_IN)
    )
    image.grid(False)
    bar.grid(False)
    return image, bar


def thumbnail(image: np.ndarray, name: str = "") -> Markup:
    """Return a small picture of the mean frame of a recording as an ``img`` element.

    Parameters
    ----------
    image : ndarray, (rows, columns)
    name : str
        Of the recording.
    """
    data = io.BytesIO()
    pixels = BRIGHTNESS(brightness_scale(image)(np.ma.masked_invalid(image)), bytes=True)
    unsigned: dict[str, Any] = {"Software": None}
    with own_style():
        matplotlib.image.imsave(data, pixels, format="png", origin="lower", metadata=unsigned)
    content = base64.b64encode(data.getvalue()).decode()
    alternative = f"mean frame of {name}" if name else "mean frame"
    return Markup('<img class="thumbnail" alt="{}" src="data:image/png;base64,{}">').format(
        alternative, content
    )


def _range(*images: np.ndarray) -> tuple[float, float]:
    """Smallest and largest finite value; 0 and 1 when there is none or no contrast."""
    values = np.concatenate([np.ravel(image) for image in images])
    values = values[np.isfinite(values)]
    if values.size == 0 or values.max() <= 0:
        return 0.0, 1.0
    return float(values.min()), float(values.max())


def _extent(shape: tuple[int, int], step: float) -> tuple[float, float, float, float]:
    half_y, half_x = (0.5 * step * side for side in shape)
    return -half_x, half_x, -half_y, half_y


def _cross_out(axes: Axes, good: np.ndarray | None, step: float) -> None:
    if good is None or good.all():
        return
    rows, columns = good.shape
    y, x = np.nonzero(~good)
    axes.plot(
        (x - (columns - 1) / 2) * step,
        (y - (rows - 1) / 2) * step,
        "x",
        color="white",
        markersize=3,
        markeredgewidth=0.7,
    )
