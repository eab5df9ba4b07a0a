"""Maps of wavefronts: one, or many side by side on one scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from irlos_pipe.report.drawing import FAINT, svg
from irlos_pipe.report.images import (
    BRIGHTNESS,
    PANEL_IN,
    SIGNED,
    brightness_scale,
    panel_axes,
    symmetric_scale,
)

CELL_IN, LARGE_CELL_IN = 1.05, 1.9
PAGE_IN = 10.0
FEW_COLUMNS = 3
LABEL_IN, TITLE_IN, BAR_IN = 0.3, 0.45, 0.75
MAP_PERCENTILE = 99.5  # the very edge of the pupil would swallow the scale


def common_limit_nm(*maps: np.ndarray) -> float:
    """Return the end of a colour scale that suits all `maps` [nm]."""
    values = np.abs(np.concatenate([np.ravel(one) for one in maps]))
    values = values[np.isfinite(values)]
    return (float(np.percentile(values, MAP_PERCENTILE)) if values.size else 0.0) or 1.0


def wavefront_grid(
    name: str,
    titles: Sequence[str],
    rows: Mapping[str, np.ndarray],
    limit_nm: float,
    images: np.ndarray | None = None,
) -> Markup:
    """Draw rows of wavefronts, one column per recording.

    Parameters
    ----------
    name : str
        Unique in the page.
    titles : sequence of str
        Of the columns.
    rows : mapping of str to ndarray, (columns, samples, samples)
        OPD [nm], NaN outside the pupil; the first is the uppermost.
    limit_nm : float
        End of the colour scale of all maps.
    images : ndarray, (columns, rows, columns), optional
        Images to stand above, each on its own asinh scale.
    """
    labels = [*(["image"] if images is not None else []), *rows]

    def draw(figure: Figure) -> None:
        grid = figure.subplots(len(labels), len(titles), squeeze=False)
        for axes, label in zip(grid[:, 0], labels, strict=True):
            axes.set_ylabel(label)
        for axes, title in zip(grid[0], titles, strict=True):
            axes.set_title(title)
        if images is not None:
            for axes, image in zip(grid[0], images, strict=True):
                axes.imshow(image, norm=brightness_scale(image), cmap=BRIGHTNESS, origin="lower")
        maps = grid[-len(rows) :]
        for line, values in zip(maps, rows.values(), strict=True):
            for axes, opd_nm in zip(line, values, strict=True):
                shown = _draw_map(axes, opd_nm, limit_nm)
        for axes in grid.flat:
            axes.grid(False)
            axes.spines[:].set_visible(False)
            axes.set(xticks=[], yticks=[])
        figure.colorbar(shown, ax=maps, label="OPD [nm]", extend="both", fraction=0.03, pad=0.01)

    cell_in = min(LARGE_CELL_IN, max(CELL_IN, PAGE_IN / len(titles)))
    size = (LABEL_IN + BAR_IN + cell_in * len(titles), TITLE_IN + cell_in * len(labels))
    return svg(name, size, draw)


def _draw_map(axes: Axes, opd_nm: np.ndarray, limit_nm: float) -> AxesImage:
    return axes.imshow(
        opd_nm, norm=symmetric_scale(limit_nm), cmap=SIGNED, origin="lower", interpolation="none"
    )


def wavefront_map(name: str, opd_nm: np.ndarray, limit_nm: float) -> Markup:
    """Draw a wavefront over the pupil, which NaN outside it show.

    Parameters
    ----------
    name : str
        Unique in the page.
    opd_nm : ndarray, (samples, samples)
    limit_nm : float
        End of the colour scale, the same for maps to be compared.
    """

    def draw(figure: Figure) -> None:
        axes, bar = panel_axes(figure)
        shown = axes.imshow(
            opd_nm,
            norm=symmetric_scale(limit_nm),
            cmap=SIGNED,
            origin="lower",
            interpolation="none",
            extent=(-1, 1, -1, 1),
        )
        axes.set_facecolor(FAINT)
        axes.set(xlabel="x [pupil radii]", ylabel="y [pupil radii]", xticks=(-1, 0, 1), yticks=(-1, 0, 1))
        figure.colorbar(shown, cax=bar, label="OPD [nm]", extend="both")

    return svg(name, PANEL_IN, draw)
