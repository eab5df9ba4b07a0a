"""Figures as SVG that take text and line colours from the page, so that they follow its dark mode.

Also curves of image quality and of misfits: OTF, encircled energy, profiles, spectra, quantiles, χ².
"""

import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple, cast

import matplotlib
import numpy as np
import scipy
from markupsafe import Markup
from matplotlib import rcsetup
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.frames.recording import star_position
from irlos_pipe.optics.image_quality import ring_means
from irlos_pipe.report.content import Figure, Width
from irlos_pipe.report.run_data import StageData

# Okabe and Ito's palette, which colour-blind readers can tell apart.
BLUE, ORANGE, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
SKY, YELLOW = "#56b4e9", "#e69f00"
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, SKY, YELLOW)
MARKERS = ("o", "s", "D", "^", "v", "P")
INK, FAINT = "#1c2733", "#c9d0d7"
# The page gives these their values, for light and for dark.
PAGE_COLOURS = {
    INK: "currentColor",
    FAINT: "var(--faint)",
    BLUE: "var(--blue)",
    ORANGE: "var(--orange)",
    GREEN: "var(--green)",
    PURPLE: "var(--purple)",
    SKY: "var(--sky)",
    YELLOW: "var(--yellow)",
}
SIZE_IN = (3.9, 2.95)
BESIDE: dict[str, dict[str, Any]] = {
    "above": {"loc": "outside upper center", "ncols": 2},
    "below": {"loc": "outside lower center", "ncols": 3},
}
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "irlos",
    "font.size": 9,
    "axes.titlesize": 9,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.grid": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "axes.prop_cycle": rcsetup.cycler(color=CYCLE),
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "figure.constrained_layout.use": True,
    "errorbar.capsize": 1.5,
    "savefig.dpi": 200,  # of what is drawn as pixels
}
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MANY = 2000  # marks, beyond which they are better drawn as pixels
# What matplotlib writes and a page must not have: a header, rules for all its elements, a size in points.
UNWANTED = re.compile(
    r'\A.*?(?=<svg)|<metadata>.*?</metadata>\s*|<style .*?</style>\s*| (?:width|height)="[\d.]+pt"', re.DOTALL
)
IDENTIFIER = re.compile(r'\sid="([^"]*)"')
REFERENCE = re.compile(r'(?<=href="#)[^"]*|(?<=url\(#)[^)]*')
FONT = re.compile(r"font-family: [^;\"]*")

Keep = Callable[[str, Canvas], None]
_KEEP: ContextVar[Keep | None] = ContextVar("keep", default=None)
# The one figure to be drawn, the axes to draw it on, and the names of all that were met.
ALONE: ContextVar[tuple[str, Axes | None, list[str]] | None] = ContextVar("alone", default=None)


@contextmanager
def kept_by(keep: Keep) -> Iterator[None]:
    """Call ``keep(name, figure)`` with every figure that is drawn in this block."""
    token = _KEEP.set(keep)
    try:
        yield
    finally:
        _KEEP.reset(token)


class OnAxes:
    """Stands for a figure of one pair of axes that is drawn on the `axes` of somebody else."""

    def __init__(self, axes: Axes) -> None:
        self.axes, self.colorbar = axes, axes.figure.colorbar

    def subplots(self, *several: int, **_: Any) -> Axes:
        if several:
            raise ConfigurationError("this figure has several axes; draw it by itself, without 'axes'")
        return self.axes

    def legend(self, **_: Any) -> None:
        self.axes.legend()


def svg(name: str, size_in: tuple[float, float], draw: Callable[[Canvas], None]) -> Markup:
    """Return a figure that `draw` fills as SVG inside a page, where identifiers begin with its `name`."""
    if alone := ALONE.get():
        wanted, axes, met = alone
        met.append(name)
        if name == wanted and axes is not None:
            draw(cast(Canvas, OnAxes(axes)))
        if name != wanted or axes is not None:
            return Markup()
    with own_style():
        figure = Canvas(figsize=size_in, dpi=matplotlib.rcParams["savefig.dpi"])
        draw(figure)
        if keep := _KEEP.get():
            keep(name, figure)
        text = io.StringIO()
        # `savefig` would draw everything twice, the first time for what only other formats need.
        FigureCanvasSVG(figure).print_svg(text, metadata={"Date": None})
    return Markup(_for_page(text.getvalue(), name))


def figure(
    name: str,
    size_in: tuple[float, float],
    draw: Callable[[Canvas], None],
    title: str,
    caption: str = "",
    width: Width = "half",
) -> Figure:
    """Return a figure that `draw` fills, to which the page links by its `name`; see `svg`."""
    return Figure(svg(name, size_in, draw), title, caption, width, name)


def plot(
    name: str,
    draw: Callable[[Axes], None],
    labels: tuple[str, str],
    title: str,
    caption: str = "",
    width: Width = "third",
    size_in: tuple[float, float] = SIZE_IN,
    legend: Any = "above",
    **settings: Any,
) -> Figure:
    """Return a figure with one pair of axes, which `draw` fills; see `svg` and `Figure`.

    The `labels` are those of x and y; the `legend` is ``above`` or ``below`` the axes; `settings` are what
    else `Axes.set` takes.
    """

    def drawn(canvas: Canvas) -> None:
        axes = canvas.subplots()
        draw(axes)
        axes.set(xlabel=labels[0], ylabel=labels[1], **settings)
        if axes.get_legend_handles_labels()[1]:
            canvas.legend(**BESIDE[legend])

    return figure(name, size_in, drawn, title, caption, width)


@contextmanager
def own_style() -> Iterator[None]:
    """Let figures look the same everywhere while the block lasts, whatever the user's matplotlibrc says."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def renamed(drawing: Markup, prefix: str) -> Markup:
    """Return a `drawing` whose identifiers begin with `prefix`, for a page with several of the same name."""
    text = IDENTIFIER.sub(lambda found: f' id="{prefix}-{found[1]}"', str(drawing))
    return Markup(REFERENCE.sub(lambda found: f"{prefix}-{found[0]}", text))


def power_of_ten(value: float, _: float = 0.0) -> str:
    """Return a number as a power of ten, which is laid out sooner than a formula."""
    return f"10{str(round(np.log10(value))).translate(RAISED)}" if value > 0 else ""


def log_y(axes: Axes, *values: np.ndarray, small: bool = False) -> None:
    """Make the y axis of `axes` logarithmic, unless none of the `values` drawn is positive.

    Where they span less than two powers of ten, one in `small` axes, numbers stand at 1, 2 and 5.
    """
    drawn = np.concatenate([np.zeros(0), *(np.ravel(value) for value in values)])
    positive = drawn[drawn > 0]
    if positive.size:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(power_of_ten)
        axes.yaxis.set_minor_formatter(NullFormatter())
        if positive.max() < (10 if small else 100) * positive.min():
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))


def _for_page(text: str, name: str) -> str:
    """Drop what a page does not need, let the page size and colour it, keep identifiers apart."""
    text = FONT.sub("font-family: inherit", UNWANTED.sub("", text))
    used = set(REFERENCE.findall(text))
    text = IDENTIFIER.sub(lambda found: f' id="{name}-{found[1]}"' if found[1] in used else "", text)
    text = REFERENCE.sub(lambda found: f"{name}-{found[0]}", text)
    for colour, page_colour in PAGE_COLOURS.items():
        text = text.replace(colour, page_colour)
    return text


# -- curves of image quality -------------------------------------------------------------------

PROFILE_IN = (4.4, 3.2)
FEWEST = 20  # values from which quantiles are worth a plot
DRAWN = 300  # points drawn in the middle; those at the ends are all drawn
ENDS = 25  # points at either end
BAND = 0.95  # probability of the grey band
OTF = (
    "Modulus of the OTF along x (solid) and y (dashed), pixels included; 1 at zero frequency. Nothing can be "
    "transferred beyond D/λ, the dotted line."
)
POWER = (
    "Azimuthal mean over the residual in σ: independent noise gives 1. Behind an AO system a complete model "
    "leaves the dashed curve: the modes take power out, and speckles, which pixels share, put it at low "
    "frequencies. Light has no structure finer than λ/D, beyond the dotted line: that comes from the pixels."
)
QUANTILES = (
    "Residuals of all pixels in σ, in order of size, against those of independent Gaussian noise of 1 σ "
    "(line; grey: 95 % of all images). A complete model leaves the dashed slope, the root of its nominal χ². "
    "Steeper is too much, and ends that bend away are single pixels or structure."
)


class Look(NamedTuple):
    """How a curve is drawn."""

    label: str
    colour: str

    @property
    def more(self) -> dict[str, Any]:
        """A broad line for what is measured, under the curves of models."""
        return {"linewidth": 4.0, "alpha": 0.35} if self.label == "measured" else {}


# Curves by the end of the names of their arrays.
BEFORE_AFTER = {"before": Look("before", ORANGE), "after": Look("after", BLUE)}
PREDICTED = {"perfect": Look("no aberration", GREEN), **BEFORE_AFTER}
DIAGNOSED = {"measured": Look("measured", INK), **BEFORE_AFTER}


def otf_figure(of: StageData[Any], name: str, looks: Mapping[str, Look]) -> Figure:
    """Return the cuts through the OTF; `looks` by the end of the names of the arrays."""
    cuts = {(key, letter): f"otf_{letter}_{key}" for key in looks for letter in "xy"}
    curves = of.known(cuts)

    def draw(axes: Axes) -> None:
        for (key, letter), values in curves.items():
            style, label = ("-", looks[key].label) if letter == "x" else ("--", None)
            at = of[f"otf_{letter}_frequency"]
            axes.plot(at, values, style, color=looks[key].colour, label=label, **looks[key].more)
        axes.axvline(1.0, color=INK, linestyle=":", linewidth=0.8)

    labels = ("spatial frequency [D/λ]", "|OTF|")
    return plot(name, draw, labels, "OTF cuts", OTF, ylim=(0, 1.02), xlim=(0, 1.15))


def energy_figure(
    of: StageData[Any], name: str, looks: Mapping[str, Look], caption: str, resolution_mas: float = np.nan
) -> Figure:
    """Return the encircled energy, with λ/D marked if `resolution_mas` is known; see `otf_figure`."""
    radius, curves = of["encircled_radius_mas"], of.known({looks[key]: f"encircled_{key}" for key in looks})

    def draw(axes: Axes) -> None:
        for look, values in curves.items():
            axes.plot(radius, 100 * values, color=look.colour, label=look.label, **look.more)
        if np.isfinite(resolution_mas):
            axes.axvline(resolution_mas, color=INK, linestyle=":", linewidth=0.8, label="λ/D")

    labels = ("radius [mas]", "encircled energy [%]")
    return plot(name, draw, labels, "Encircled energy", caption, ylim=(0, 101), xlim=(0, None))


def power_figure(of: StageData[Any], name: str, looks: Mapping[str, Look]) -> Figure:
    """Return the power spectrum of the residual; see `otf_figure`."""
    at, curves = of["left_frequency"], of.known({looks[key]: f"left_power{key}" for key in looks})
    nominal = of.known({"": "left_nominal"})[""] if "left_nominal" in of.arrays else None

    def draw(axes: Axes) -> None:
        for look, values in curves.items():
            axes.plot(at, np.where(values > 0, values, np.nan), ".-", color=look.colour, label=look.label)
        axes.axhline(1.0, color=INK, linewidth=0.7, label="independent noise")
        if nominal is not None:
            axes.plot(at, nominal, "--", color=GREEN, label="nominal")
        axes.axvline(1.0, color=INK, linestyle=":", linewidth=0.8)
        log_y(axes, *curves.values())

    labels = ("spatial frequency [D/λ]", "power [σ²]")
    return plot(name, draw, labels, "Power spectrum of the residual", POWER, xlim=(0, None))


# -- radial profiles ---------------------------------------------------------------------------


def star_profile(
    name: str,
    images: Mapping[str, tuple[np.ndarray, str, str]],
    model_e: np.ndarray,
    pixel_scale_mas: float | None,
) -> Markup:
    """Draw radial means about the centroid of a star's `model_e`, (rows, columns); radii in px if no scale.

    `images` are by label: image (rows, columns) [e-], NaN where it is not used, colour and line style.
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
    size_in: tuple[float, float] = PROFILE_IN,
) -> Markup:
    """Draw profiles on a logarithmic axis; values that are not positive leave gaps.

    `curves` are by label: radius, values, colour and line style; `units` are the unit of the radius and the
    label of the axis of the values.
    """

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        for label, (radius, values, colour, style) in curves.items():
            axes.plot(radius, np.where(values > 0, values, np.nan), style, color=colour, label=label)
        axes.set(xlabel=f"radius [{units[0]}]", ylabel=units[1])
        axes.set_xlim(left=0)
        log_y(axes, *(values for _, values, *_ in curves.values()))
        canvas.legend(**BESIDE["above"])

    return svg(name, size_in, draw)


# -- how well models fit -----------------------------------------------------------------------


def normal_quantiles(count: int) -> np.ndarray:
    """Return where `count` normal deviates in order of size are expected, to a few per mille (Blom 1958)."""
    return scipy.special.ndtri((np.arange(1, count + 1) - 0.375) / (count + 0.25))


def quantile_band(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return between what values each of so many normal deviates in order of size lies in 95 % of all cases.

    The i-th of n uniform deviates in order of size has the distribution Beta(i, n + 1 − i).
    """
    rank = np.arange(1, count + 1)
    low, high = (
        scipy.special.ndtri(scipy.special.betaincinv(rank, count + 1 - rank, part))
        for part in ((1 - BAND) / 2, (1 + BAND) / 2)
    )
    return low, high


def quantile_figure(
    name: str, residuals: Mapping[Look, np.ndarray], nominal: float = np.nan
) -> Figure | None:
    """Return quantiles of residuals against those of noise; None where too few values are known.

    The `residuals` are in σ, of any shape, NaN where a pixel does not count; `nominal` is the mean of their
    squares that a complete model leaves, NaN if not known.
    """
    found = {look: np.sort(values[np.isfinite(values)]) for look, values in residuals.items()}
    known = {look: values for look, values in found.items() if len(values) >= FEWEST}
    if not known:
        return None
    count = max(map(len, known.values()))

    def draw(axes: Axes) -> None:
        at, chosen, (low, high) = normal_quantiles(count), _drawn(count), quantile_band(count)
        axes.fill_between(at[chosen], low[chosen], high[chosen], color=FAINT, linewidth=0)
        axes.plot(at[[0, -1]], at[[0, -1]], color=INK, linewidth=0.9, label="noise of 1 σ")
        if nominal > 0:
            axes.plot(at[[0, -1]], nominal**0.5 * at[[0, -1]], "--", color=GREEN, label="nominal")
        for look, values in known.items():
            own, place = _drawn(len(values)), normal_quantiles(len(values))
            axes.plot(place[own], values[own], ".", color=look.colour, label=look.label)

    labels = ("expected of noise [σ]", "residual [σ]")
    return plot(name, draw, labels, "Quantiles of the residual", QUANTILES)


def _drawn(count: int) -> np.ndarray:
    """Indices of the values that are drawn: both ends in full, the middle thinned out."""
    middle = np.linspace(0, count - 1, min(count, DRAWN)).astype(int)
    ends = np.concatenate([np.arange(min(ENDS, count)), np.arange(max(count - ENDS, 0), count)])
    return np.unique(np.concatenate([middle, ends]))
