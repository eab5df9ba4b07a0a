"""Figures as SVG that take text and line colours from the page, so that they follow its dark mode."""

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, cast

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib import rcsetup
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.report.content import Figure, Width

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
