"""Effects that change the drawing of the pupil: where its edges are.

Edges are drawn on a grid of a few mm and band-limited. Several such effects make one drawing: the edge of a
turned vane that is wider than told is where both say. What gives parts of the pupil a wavefront of their own
(`divided_pupil`) has the parts of that drawing: petals turn with the vanes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.planes import PupilEffect
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.pupil import Division, band_limited
from irlos_pipe.optics.pupil_cover import ON_AXIS
from irlos_pipe.optics.pupil_edges import Edges, pupil_edges

CELL_M = 0.008  # of the drawing


class Drawing(NamedTuple):
    """A pupil, and where an internal stop of its outline and hole lies [m]."""

    geometry: PupilGeometry
    stop_m: tuple[float, float] = ON_AXIS
    turned_deg: float = 0.0  # against the pupil that was told


class DrawnEffect(PupilEffect):
    """Acts on where there is light: on the drawing of the pupil, or on parts of what is drawn."""

    order = 0  # changes where there is light, before what multiplies it
    joins = "redrawn_pupil"


class RedrawnPupil(DrawnEffect):
    """Changes the drawing of the pupil."""

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect:
        """See `Effect.together`: one drawing with all of them."""
        return RedrawnTogether(effects)

    def redrawn(self, values: Sequence[float], drawing: Drawing) -> Drawing:
        """The `drawing` with the effect at `values`."""
        raise NotImplementedError

    def edge_slope(self, values: Sequence[float], index: int, edges: Edges) -> np.ndarray:
        """Derivative of the amplitude with respect to the parameter `index`, (n, n).

        Parameters
        ----------
        values : sequence of float
        index : int
        edges : Edges
            Of the whole drawing, other effects included.
        """
        raise NotImplementedError

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """See `PupilEffect.apply`."""
        change = _differentiable().apply(values, self, grid) if len(values) else _changed(values, self, grid)
        return field + change * grid.light

    def slopes(
        self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """See `PupilEffect.slopes`."""
        every = torch.ones_like(grid.wavelengths_m, dtype=torch.complex128) * grid.light
        return [every * slope for slope in slopes_of_drawing(self, grid, values, wanted)]


class RedrawnTogether(RedrawnPupil):
    """Several effects that make one drawing.

    Parameters
    ----------
    effects : sequence of Effect
        Each a `RedrawnPupil`, some of whose parameters may be held.
    """

    name = "redrawn_pupil"

    def __init__(self, effects: Sequence[Effect]):
        self._effects = tuple(effects)
        self.parameters = tuple(p for one in effects for p in one.parameters)
        self._owners = [(number, index) for number, one in enumerate(effects) for index in one.free]

    def redrawn(self, values: Sequence[float], drawing: Drawing) -> Drawing:
        """See `RedrawnPupil.redrawn`: one after the other."""
        for effect, own in self._each(values):
            drawing = effect.redrawn(own, drawing)
        return drawing

    def edge_slope(self, values: Sequence[float], index: int, edges: Edges) -> np.ndarray:
        """See `RedrawnPupil.edge_slope`."""
        number, own_index = self._owners[index]
        effect, own = self._each(values)[number]
        return effect.edge_slope(own, own_index, edges)

    def _each(self, values: Sequence[float]) -> list[tuple[RedrawnPupil, list[float]]]:
        """Every effect with all its parameters."""
        pieces = torch.tensor(values, dtype=torch.float64).split(
            [len(one.parameters) for one in self._effects]
        )
        pairs = zip(self._effects, pieces, strict=True)
        return [(one.base, one.all_values(piece).tolist()) for one, piece in pairs]  # type: ignore[misc]


@cache
def _differentiable() -> type[torch.autograd.Function]:
    """Change of the band-limited amplitude by an effect, (n, n)."""

    class Change(torch.autograd.Function):
        @staticmethod
        def forward(values, effect, grid):
            return _changed(values, effect, grid)

        @staticmethod
        def setup_context(ctx, inputs, output):
            values, ctx.effect, ctx.grid = inputs
            ctx.values = values.detach()

        @staticmethod
        def backward(ctx, upstream):
            slopes = slopes_of_drawing(ctx.effect, ctx.grid, ctx.values, range(len(ctx.values)))
            return torch.stack([(upstream * slope).sum() for slope in slopes]), None, None

    return Change


def _changed(values: torch.Tensor, effect: RedrawnPupil, grid: PupilGrid) -> torch.Tensor:
    told = Drawing(grid.geometry)
    drawing = effect.redrawn(values.tolist(), told)
    return torch.tensor(_drawn(drawing, grid.samples) - _drawn(told, grid.samples))


def slopes_of_drawing(
    effect: RedrawnPupil,
    grid: PupilGrid,
    values: torch.Tensor,
    wanted: Sequence[int],
    division: Division | None = None,
) -> list[torch.Tensor]:
    """Return derivatives of the amplitude of the pupil, (n, n) each, or of its parts, (parts, n, n) each.

    Parameters
    ----------
    effect : RedrawnPupil
    grid : PupilGrid
    values : tensor, (parameters,)
    wanted : sequence of int
        Positions of the parameters.
    division : Division, optional
        Into parts.
    """
    numbers = values.tolist()
    geometry, stop_m, _ = effect.redrawn(numbers, Drawing(grid.geometry))
    edges = pupil_edges(geometry, grid.samples, subsamples_of(geometry, grid.samples), stop_m, division)
    return [torch.as_tensor(effect.edge_slope(numbers, index, edges)) for index in wanted]


@lru_cache(maxsize=16)
def _drawn(drawing: Drawing, samples: int) -> np.ndarray:
    """Band-limited amplitude, (n, n)."""
    geometry, stop_m, _ = drawing
    return band_limited(geometry, samples, stop_m=stop_m, subsamples=subsamples_of(geometry, samples))


def subsamples_of(geometry: PupilGeometry, samples: int) -> int:
    """Return the even number of fine cells of about `CELL_M` per coarse cell.

    Parameters
    ----------
    geometry : PupilGeometry
    samples : int
        Across the diameter.
    """
    return 2 * int(np.ceil(geometry.diameter_m / samples / CELL_M / 2))
