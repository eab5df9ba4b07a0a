"""Images, residuals and wavefronts with their colours; thumbnails."""

import base64
import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm, Colormap, LogNorm, Normalize
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Circle
from matplotlib.ticker import EngFormatter, ScalarFormatter

from irlos_pipe.report.content import Figure, Views, Width
from irlos_pipe.report.drawing import FAINT, INK, OnAxes, own_style, power_of_ten, svg

BRIGHTNESS = matplotlib.colormaps["inferno"].with_extremes(bad="#8d979f")
SIGNED = matplotlib.colormaps["RdBu_r"].with_extremes(bad="#8d979f00")
PANEL_IN = (4.0, 2.85)
# Where the image and its colour bar stand in a panel: left, bottom, width, height [inch].
IMAGE_BOX_IN = (0.65, 0.45, 2.3, 2.3)
BAR_BOX_IN = (3.03, 0.45, 0.1, 2.3)
SIGMA_LIMIT = 5.0  # least end of the scale of residuals in σ
DECADES = 4.0  # below the maximum that a logarithmic scale shows
# The asinh scale turns linear below this part of the peak.
LINEAR_PART = 3e-3
MANY_DIGITS = 1e4  # number from which ticks are written as 12k or with a power of ten
TICK_ROOM = 0.07  # part of a colour bar that a label needs
PERCENTILE = 99.8  # of residuals, for the end of their scale: single pixels would swallow it
LINEAR_SIGMA = 2.0  # within which an asinh scale of residuals is linear: what is noise
CELL_IN, LARGE_CELL_IN = 1.05, 1.9
PAGE_IN = 10.0
LABEL_IN, TITLE_IN, BAR_IN = 0.3, 0.45, 0.75
MAP_PERCENTILE = 99.5  # end of the scale: the very edge of the pupil would swallow it


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


def symmetric_scale(limit: float, linear_width: float | None = None) -> Normalize:
    """Return a scale from -`limit` to `limit`: linear, or asinh, which is linear within `linear_width`."""
    if linear_width is None:
        return Normalize(-limit, limit)
    return AsinhNorm(linear_width, -limit, limit)


def panel(
    name: str,
    values: np.ndarray,
    scale: Normalize,
    label: str,
    draw: Callable[[Axes], object],
    colours: Colormap = SIGNED,
    extend: str = "neither",
    ticks: Sequence[float] | None = None,
    **look: Any,
) -> Markup:
    """Draw a picture (rows, columns) with its colour bar `label`; row 0 is at the bottom.

    The `name` is unique in the page; `draw` adds to the axes what the picture has besides the values;
    `extend` and `ticks` are of the colour bar, ends that are pointed and where it has numbers; `look` is for
    `Axes.imshow`.
    """

    def drawn(canvas: Canvas) -> None:
        axes, bar = panel_axes(canvas)
        shown = axes.imshow(
            values, norm=scale, cmap=colours, **{"origin": "lower", "interpolation": "none"} | look
        )
        draw(axes)
        canvas.colorbar(shown, cax=bar, label=label, extend=extend, ticks=ticks)
        if ticks is None:
            label_bar(bar, scale)

    return svg(name, PANEL_IN, drawn)


def image_panel(
    name: str,
    image: np.ndarray,
    scale: Normalize,
    pixel_scale_mas: float | None,
    unit: str,
    colours: Colormap = BRIGHTNESS,
    good: np.ndarray | None = None,
    ring: Ring | None = None,
) -> Markup:
    """Draw an image; axes in mas (px without a scale) from the centre of the window; see `panel`.

    Pixels that are not `good` were not used and get a cross; a `ring` is drawn about a place.
    """
    step, axis_unit = (pixel_scale_mas, "mas") if pixel_scale_mas else (1.0, "px")
    half_y, half_x = (0.5 * step * side for side in image.shape)

    def draw(axes: Axes) -> None:
        axes.set(xlabel=f"x [{axis_unit}]", ylabel=f"y [{axis_unit}]")
        if good is not None and not good.all():
            y, x = np.nonzero(~good)
            place: dict[str, Any] = {"color": "white", "markersize": 3, "markeredgewidth": 0.7}
            axes.plot((x + 0.5) * step - half_x, (y + 0.5) * step - half_y, "x", **place)
        if ring:
            axes.add_patch(Circle((ring.x, ring.y), ring.diameter / 2, fill=False, color=INK, linestyle="--"))

    return panel(name, image, scale, unit, draw, colours, extent=(-half_x, half_x, -half_y, half_y))


def label_bar(bar: Axes, scale: Normalize) -> None:
    """Give a colour `bar` numbers that are short enough to leave the unit its place and do not overlap."""
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
    candidates = np.array([0.0, *powers, *(3 * power for power in powers)])
    candidates = candidates[
        (low <= candidates) & (candidates <= high) & ((abs(candidates) > width / 10) | (candidates == 0))
    ]
    found: dict[float, float] = {}
    for tick, place in zip(candidates.tolist(), np.asarray(scale(candidates)).tolist(), strict=True):
        if all(abs(place - other) > TICK_ROOM for other in found.values()):
            found[tick] = place
    return sorted(found)


def _short_number(value: float, _: int | None = None) -> str:
    return f"{value:.6g}".replace("-", "−")


def _short(value: float) -> str:
    """A tick of an asinh scale, written out where that is short."""
    if value == 0 or 1e-2 <= abs(value) < MANY_DIGITS:
        return _short_number(value)
    power = 10.0 ** math.floor(math.log10(abs(value)) + 1e-9)
    factor = round(abs(value) / power)
    return f"{'−' if value < 0 else ''}{'' if factor == 1 else f'{factor}·'}{power_of_ten(power)}"


def panel_axes(canvas: Canvas | OnAxes) -> tuple[Axes, Axes]:
    """Add axes for a square image and for a colour bar of the same height."""
    if isinstance(canvas, OnAxes):
        canvas.axes.grid(False)
        return canvas.axes, canvas.axes.inset_axes((1.04, 0, 0.05, 1))
    canvas.set_layout_engine("none")
    width, height = canvas.get_size_inches()
    image, bar = (
        canvas.add_axes((left / width, bottom / height, across / width, up / height))
        for left, bottom, across, up in (IMAGE_BOX_IN, BAR_BOX_IN)
    )
    image.grid(False)
    bar.grid(False)
    return image, bar


def thumbnail(image: np.ndarray, name: str = "") -> Markup:
    """Return a small picture of the mean frame of the recording `name` as an ``img`` element."""
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


# -- the same in several ways ------------------------------------------------------------------


def _side_by_side(
    name: str, images: Mapping[str, tuple[np.ndarray, str]], good: np.ndarray | None = None, **look: Any
) -> list[Figure]:
    """Images with their captions, pixels that are not `good` crossed out in the first."""
    return [
        Figure(
            image_panel(f"{name}-{place}", image, good=None if place else good, **look),
            title,
            caption,
            "third",
        )
        for place, (title, (image, caption)) in enumerate(images.items())
    ]


def image_views(
    name: str,
    images: Mapping[str, tuple[np.ndarray, str]],
    pixel_scale_mas: float | None,
    good: np.ndarray | None = None,
    width: Width = "full",
) -> Views:
    """Return `images`, by title (rows, columns) [e-] and a caption, on one scale, asinh or linear.

    Pixels that are not `good` get a cross in the first image; `width` is that of all together.
    """
    choices, shown = {}, [image for image, _ in images.values()]
    low, high = _range(*shown)
    scales = {"logarithmic": brightness_scale(*shown), "linear": Normalize(min(low, 0.0), high)}
    for label, scale in scales.items():
        look = {"scale": scale, "unit": "e⁻", "pixel_scale_mas": pixel_scale_mas}
        choices[label] = _side_by_side(f"{name}-{label}", images, good, **look)
    return Views(name, choices, width)


def residual_views(
    name: str,
    residuals: Mapping[str, tuple[np.ndarray, str]],
    sigma_e: np.ndarray | None,
    peak_e: float,
    pixel_scale_mas: float | None,
    width: Width = "full",
) -> Views:
    """Return residuals on one scale: in σ and in per cent of the peak, asinh and linear.

    By title, `residuals` are measured minus predicted (rows, columns) [e-], and a caption. The standard
    errors `sigma_e` (rows, columns) are 0 or not finite where a pixel is not used; without them there are no
    σ. The peak is that of the predicted image.
    """
    factors = {} if sigma_e is None else {"σ": in_sigma(np.ones(sigma_e.shape), sigma_e)}
    factors["% of the peak"] = np.array(100 / peak_e if peak_e > 0 else np.nan)
    choices: dict[str, list[Figure]] = {}
    for unit, factor in factors.items():
        images = {title: (image * factor, caption) for title, (image, caption) in residuals.items()}
        least, linear = (SIGMA_LIMIT, LINEAR_SIGMA) if unit == "σ" else (0.0, None)
        limit = max(least, *(percentile(PERCENTILE, image) or 1e-3 for image, _ in images.values()))
        look: dict[str, Any] = {"colours": SIGNED, "unit": unit, "pixel_scale_mas": pixel_scale_mas}
        for label, linear_width in {"log": linear or limit / 100, "linear": None}.items():
            scale = symmetric_scale(limit, linear_width)
            place = f"{name}-{len(choices)}"
            choices[f"{unit[0]} {label}"] = _side_by_side(place, images, scale=scale, **look)
    return Views(name, choices, width)


def in_sigma(residual: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return a `residual` over its standard errors, NaN where a pixel is not used."""
    used = np.isfinite(sigma) & (sigma > 0)
    return residual * np.where(used, 1 / np.where(used, sigma, 1.0), np.nan)


def percentile(percent: float, *maps: np.ndarray) -> float:
    """Return a percentile of the absolute values of all `maps`, where they are finite; 0 without any."""
    values = np.abs(np.concatenate([np.ravel(one) for one in maps]))
    values = values[np.isfinite(values)]
    return float(np.percentile(values, percent)) if values.size else 0.0


# -- wavefronts --------------------------------------------------------------------------------


def common_limit_nm(*maps: np.ndarray) -> float:
    """Return the end of a colour scale that suits all `maps` [nm]."""
    return percentile(MAP_PERCENTILE, *maps) or 1.0


def wavefront_grid(
    name: str,
    titles: Sequence[str],
    rows: Mapping[str, np.ndarray],
    limit_nm: float,
    images: np.ndarray | None = None,
) -> Markup:
    """Draw rows of wavefronts, one column per recording, with `titles` of the columns.

    The `rows`, the uppermost first, are OPD (columns, samples, samples) [nm], NaN outside the pupil; the
    colour scale of all ends at `limit_nm`. The `images` (columns, rows, columns) stand above, each on its own
    asinh scale.
    """
    labels = [*(["image"] if images is not None else []), *rows]

    def draw(canvas: Canvas) -> None:
        grid = canvas.subplots(len(labels), len(titles), squeeze=False)
        for axes, label in zip(grid[:, 0], labels, strict=True):
            axes.set_ylabel(label)
        for axes, title in zip(grid[0], titles, strict=True):
            axes.set_title(title)
        if images is not None:
            for axes, image in zip(grid[0], images, strict=True):
                axes.imshow(image, norm=brightness_scale(image), cmap=BRIGHTNESS, origin="lower")
        maps = grid[-len(rows) :]
        look: dict[str, Any] = {"cmap": SIGNED, "origin": "lower", "interpolation": "none"}
        for line, values in zip(maps, rows.values(), strict=True):
            for axes, opd_nm in zip(line, values, strict=True):
                shown = axes.imshow(opd_nm, norm=symmetric_scale(limit_nm), **look)
        for axes in grid.flat:
            axes.grid(False)
            axes.spines[:].set_visible(False)
            axes.set(xticks=[], yticks=[])
        canvas.colorbar(shown, ax=maps, label="OPD [nm]", extend="both", fraction=0.03, pad=0.01)

    cell_in = min(LARGE_CELL_IN, max(CELL_IN, PAGE_IN / len(titles)))
    return svg(name, (LABEL_IN + BAR_IN + cell_in * len(titles), TITLE_IN + cell_in * len(labels)), draw)


def pupil_map(name: str, values: np.ndarray, limit: float, label: str, **axes: Any) -> Markup:
    """Draw a map of the pupil about zero, NaN where it is dark; `axes` is what `Axes.set` takes.

    The `limit` of the colours is the same for maps to be compared; coordinates are in radii of the pupil.
    """

    def draw(drawn: Axes) -> None:
        drawn.set_facecolor(FAINT)
        drawn.set(**axes)

    return panel(name, values, symmetric_scale(limit), label, draw, extend="both", extent=(-1, 1, -1, 1))
