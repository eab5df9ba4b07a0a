"""Parts of the pupil with wavefronts of their own, as the pupil is drawn: petals turn with the vanes.

The field is the sum of the fields of the parts, each with its own band-limited amplitude: a step within a
vane or a gap needs no finer grid than the vane itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.redrawn_pupil import (
    Drawing,
    DrawnEffect,
    RedrawnPupil,
    RedrawnTogether,
    differentiable,
    slopes_of_drawing,
    subsamples_of,
)
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.pupil import Division, band_limited_parts
from irlos_pipe.optics.pupil_division import amplitudes_of


class DividedPupil(DrawnEffect):
    """Gives parts of the pupil, as it is drawn, wavefronts of their own."""

    order = -1  # the first of those that act on the drawing, as it joins them

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect | None:
        """See `Effect.together`: the parts of one drawing, where there is one."""
        redrawn = any(isinstance(one.base, RedrawnPupil) for one in effects)
        return RedrawnAndDivided(effects) if redrawn else None

    @staticmethod
    def parts_of(geometry: PupilGeometry) -> Division:
        """Return the parts of a pupil `geometry`."""
        raise NotImplementedError

    def factors(self, values: Tensor, grid: PupilGrid) -> list[Tensor]:
        """Return the complex factor of each part at `values` on `grid`, (wavelengths, n, n)."""
        raise NotImplementedError

    def moved(
        self, values: Tensor, amplitudes: Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[Tensor]:
        """Return derivatives of the field by the `wanted` parameters, see `slopes`.

        `amplitudes` (parts, n, n) are those of the parts on `grid`; `values` (parameters,).
        """
        raise NotImplementedError

    def opd_where(self, values: Tensor, index: Tensor, grid: PupilGrid) -> Tensor:
        """Return the OPD at `values`, (n, n) [nm]; `index` (n, n) is the number of the part at points of
        `grid`.
        """
        raise NotImplementedError

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        return _added(field, _parts(type(self), grid, Drawing(grid.geometry)), self.factors(values, grid))

    def slopes(self, values: Tensor, field: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> list[Tensor]:
        return self.moved(values, _parts(type(self), grid, Drawing(grid.geometry)), grid, wanted)

    def opd_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        return self.opd_where(values, _index_on(type(self), grid, Drawing(grid.geometry)), grid)


class RedrawnAndDivided(DrawnEffect):
    """A drawing of the pupil, and wavefronts of its parts.

    Each of the `effects` is a `RedrawnPupil` or a `DividedPupil`, some of whose parameters may be held.
    """

    name = "redrawn_and_divided_pupil"

    def __init__(self, effects: Sequence[Effect]):
        self.parameters = tuple(p for one in effects for p in one.parameters)
        ends = np.cumsum([0, *(len(one.parameters) for one in effects)])
        pieces = [list(range(a, b)) for a, b in pairwise(ends.tolist())]
        pairs = list(zip(effects, pieces, strict=True))
        redrawing = [pair for pair in pairs if isinstance(pair[0].base, RedrawnPupil)]
        self._redrawn = RedrawnTogether([one for one, _ in redrawing])
        self._drawing = [place for _, piece in redrawing for place in piece]
        self._dividing = [pair for pair in pairs if isinstance(pair[0].base, DividedPupil)]

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        drawing = values[self._drawing]
        field = self._redrawn.apply(drawing, field, grid)
        for base, own in self._each(values):
            parts = differentiable(
                drawing,
                partial(_parts_drawn, self._redrawn, type(base), grid),
                partial(_part_slopes, self._redrawn, type(base), grid, grid.light),
            )
            field = _added(field, parts, base.factors(own, grid))
        return field

    def slopes(self, values: Tensor, field: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> list[Tensor]:
        found = dict(zip(self._drawing, self._slopes_of_edges(values, field, grid), strict=True))
        drawn = self._drawn(values, grid)
        for (effect, piece), (base, own) in zip(self._dividing, self._each(values), strict=True):
            moved = base.moved(own, _parts(type(base), grid, drawn), grid, effect.free)
            found |= zip(piece, moved, strict=True)
        return [found[index] for index in wanted]

    def _slopes_of_edges(self, values: Tensor, field: Tensor, grid: PupilGrid) -> list[Tensor]:
        """Derivatives of the field with respect to the parameters of the drawing."""
        drawing, every = values[self._drawing], range(len(self._drawing))
        slopes = self._redrawn.slopes(drawing, field, grid, every)
        for base, own in self._each(values):
            changes = torch.stack(base.factors(own, grid)) - 1
            moved = _part_slopes(self._redrawn, type(base), grid, 1.0, drawing)
            slopes = [
                slope + grid.light * (changes * parts[:, None]).sum(0)
                for slope, parts in zip(slopes, moved, strict=True)
            ]
        return slopes

    def opd_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        """See `PupilEffect.opd_nm`: parts turn with the pupil."""
        drawn = self._drawn(values, grid)
        maps = [
            base.opd_where(own, _index_on(type(base), grid, drawn), grid) for base, own in self._each(values)
        ]
        return torch.stack(maps).sum(0)

    def _drawn(self, values: Tensor, grid: PupilGrid) -> Drawing:
        return self._redrawn.redrawn(values[self._drawing].tolist(), Drawing(grid.geometry))

    def _each(self, values: Tensor) -> list[tuple[DividedPupil, Tensor]]:
        """Every effect of parts with all its parameters."""
        return [(one.base, one.all_values(values[piece])) for one, piece in self._dividing]  # type: ignore[misc]


def _added(field: Tensor, parts: Tensor, factors: Sequence[Tensor]) -> Tensor:
    """A `field` whose `parts` (parts, n, n) have got `factors`."""
    for part, factor in zip(parts, factors, strict=True):
        field = field + part * (factor - 1)
    return field


def _parts(kind: type[DividedPupil], grid: PupilGrid, drawing: Drawing) -> Tensor:
    """Amplitude of each part of a `drawing`, (parts, n, n): as declared, and what the drawing changes."""
    geometry, samples = grid.geometry, grid.samples
    parts, declared = amplitudes_of(kind.parts_of(geometry), geometry, samples), Drawing(geometry)
    if drawing != declared:
        drawn = (_drawn_parts(kind, geometry, one, samples) for one in (drawing, declared))  # type: ignore[arg-type]
        parts = parts + next(drawn) - next(drawn)
    return torch.as_tensor(np.where(grid.lit, parts, 0) * grid.light)


def _parts_drawn(effect: RedrawnPupil, kind: type[DividedPupil], grid: PupilGrid, values: Tensor) -> Tensor:
    """The same of the drawing that an `effect` makes."""
    return _parts(kind, grid, effect.redrawn(values.tolist(), Drawing(grid.geometry)))


@lru_cache(maxsize=8)
def _drawn_parts(
    kind: type[DividedPupil], declared: PupilGeometry, drawing: Drawing, samples: int
) -> np.ndarray:
    """Band-limited amplitude of each part of a pupil as `declared`, as it is drawn, (parts, n, n)."""
    division = _division(kind, declared, drawing)
    options: Any = {"stop_m": drawing.stop_m, "subsamples": subsamples_of(declared, samples)}
    return band_limited_parts(drawing.geometry, samples, division, **options)


def _part_slopes(
    effect: RedrawnPupil, kind: type[DividedPupil], grid: PupilGrid, light: float, values: Tensor
) -> list[Tensor]:
    """Derivatives of the amplitudes of all parts, times `light`, by each parameter, (parts, n, n) each."""
    declared = Drawing(grid.geometry)
    division = _division(kind, declared.geometry, effect.redrawn(values.tolist(), declared))
    return [light * one for one in slopes_of_drawing(effect, grid, values, range(len(values)), division)]


def _index_on(kind: type[DividedPupil], grid: PupilGrid, drawing: Drawing) -> Tensor:
    """Number of the part of a `drawing` at the points of a `grid`, (n, n)."""
    x_m, y_m = (axis * grid.radius_m for axis in grid.xy)
    return torch.as_tensor(_division(kind, grid.geometry, drawing).index(x_m, y_m))


def _division(kind: type[DividedPupil], declared: PupilGeometry, drawing: Drawing) -> Division:
    """The parts of a pupil as `declared`, turned as it is drawn."""
    parts = kind.parts_of(declared)

    def index(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        return parts.index(*_before_turning(x_m, y_m, drawing.turned_deg))

    return Division(index, parts.count)


def _before_turning(x_m: np.ndarray, y_m: np.ndarray, turned_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Where points of a turned pupil were before it turned."""
    if turned_deg == 0:
        return x_m, y_m
    cosine, sine = np.cos(np.deg2rad(turned_deg)), np.sin(np.deg2rad(turned_deg))
    return cosine * x_m + sine * y_m, cosine * y_m - sine * x_m
