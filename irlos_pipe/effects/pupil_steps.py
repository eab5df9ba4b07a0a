"""Parts of the pupil out of step: `low_wind_effect` and `segment_piston`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial, reduce
from itertools import pairwise
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects.base import Effect, Several
from irlos_pipe.effects.declaration import Conditions, Parameter, Public
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
from irlos_pipe.optics.pupil import Division, amplitudes_of, band_limited_parts, petals_of, segments_of

UT4_PETALS = 4
PISTONS = {"piston_nm": 1}
PISTONS_AND_SLOPES = {"piston_nm": 1, "tip_nm": 2, "tilt_nm": 3}
RMS_OF_PISTON, RMS_OF_SLOPES = "piston_rms_nm", "slopes_rms_nm"


class RedrawnAndDivided(Several, DrawnEffect):
    """A drawing of the pupil, and wavefronts of its parts.

    Each of the `effects` is a `RedrawnPupil` or a `PupilSteps`, some of whose parameters may be held.
    """

    name = "redrawn_and_divided_pupil"

    def __init__(self, effects: Sequence[Effect]):
        super().__init__(effects)
        ends = np.cumsum([0, *(len(one.parameters) for one in effects)])
        pieces = [list(range(a, b)) for a, b in pairwise(ends.tolist())]
        pairs = list(zip(effects, pieces, strict=True))
        redrawing = [pair for pair in pairs if isinstance(pair[0].base, RedrawnPupil)]
        self._redrawn = RedrawnTogether([one for one, _ in redrawing])
        self._drawing = [place for _, piece in redrawing for place in piece]
        self._dividing = [pair for pair in pairs if isinstance(pair[0].base, PupilSteps)]

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        drawing = values[self._drawing]
        field = self._redrawn.apply(drawing, field, grid)
        for base, own in self._each(values):
            kind = type(base)
            parts = differentiable(
                drawing,
                partial(self._parts, kind, grid),
                partial(_part_slopes, self._redrawn, kind, grid, grid.light),
            )
            field = _added(field, parts, base.factors(own, grid))
        return field

    def slopes(self, values: Tensor, field: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> list[Tensor]:
        found = dict(zip(self._drawing, self._slopes_of_edges(values, field, grid), strict=True))
        drawn = self._drawn(values[self._drawing], grid)
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
        drawn = self._drawn(values[self._drawing], grid)
        maps = [
            base.opd_where(own, _index_on(type(base), grid, drawn), grid) for base, own in self._each(values)
        ]
        return torch.stack(maps).sum(0)

    def _parts(self, kind: type[PupilSteps], grid: PupilGrid, drawing: Tensor) -> Tensor:
        return _parts(kind, grid, self._drawn(drawing, grid))

    def _drawn(self, drawing: Tensor, grid: PupilGrid) -> Drawing:
        return self._redrawn.redrawn(drawing.tolist(), Drawing(grid.geometry))

    def _each(self, values: Tensor) -> list[tuple[PupilSteps, Tensor]]:
        """Every effect of parts with all its parameters."""
        return [(one.base, one.all_values(values[piece])) for one, piece in self._dividing]  # type: ignore[misc]


def _added(field: Tensor, parts: Tensor, factors: Sequence[Tensor]) -> Tensor:
    """A `field` whose `parts` (parts, n, n) have got `factors`."""
    for part, factor in zip(parts, factors, strict=True):
        field = field + part * (factor - 1)
    return field


def _parts(kind: type[PupilSteps], grid: PupilGrid, drawing: Drawing) -> Tensor:
    """Amplitude of each part of a `drawing`, (parts, n, n): as declared, and what the drawing changes."""
    geometry, samples = grid.geometry, grid.samples
    parts, declared = amplitudes_of(kind.parts_of(geometry), geometry, samples), Drawing(geometry)
    if drawing != declared:
        drawn = (_drawn_parts(kind, geometry, one, samples) for one in (drawing, declared))  # type: ignore[arg-type]
        parts = parts + next(drawn) - next(drawn)
    return torch.as_tensor(np.where(grid.lit, parts, 0) * grid.light)


@lru_cache(maxsize=8)
def _drawn_parts(
    kind: type[PupilSteps], declared: PupilGeometry, drawing: Drawing, samples: int
) -> np.ndarray:
    """Band-limited amplitude of each part of a pupil as `declared`, as it is drawn, (parts, n, n)."""
    division = _division(kind, declared, drawing)
    options: Any = {"stop_m": drawing.stop_m, "subsamples": subsamples_of(declared, samples)}
    return band_limited_parts(drawing.geometry, samples, division, **options)


def _part_slopes(
    effect: RedrawnPupil, kind: type[PupilSteps], grid: PupilGrid, light: float, values: Tensor
) -> list[Tensor]:
    """Derivatives of the amplitudes of all parts, times `light`, by each parameter, (parts, n, n) each."""
    declared = Drawing(grid.geometry)
    division = _division(kind, declared.geometry, effect.redrawn(values.tolist(), declared))
    return [light * one for one in slopes_of_drawing(effect, grid, values, range(len(values)), division)]


def _index_on(kind: type[PupilSteps], grid: PupilGrid, drawing: Drawing) -> Tensor:
    """Number of the part of a `drawing` at the points of a `grid`, (n, n)."""
    x_m, y_m = (axis * grid.radius_m for axis in grid.xy)
    return torch.as_tensor(_division(kind, grid.geometry, drawing).index(x_m, y_m))


def _division(kind: type[PupilSteps], declared: PupilGeometry, drawing: Drawing) -> Division:
    """The parts of a pupil as `declared`, turned as it is drawn."""
    parts, turn = kind.parts_of(declared), np.deg2rad(drawing.turned_deg)
    cosine, sine = np.cos(turn), np.sin(turn)

    def index(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        if turn == 0:
            return parts.index(x_m, y_m)
        return parts.index(cosine * x_m + sine * y_m, cosine * y_m - sine * x_m)

    return Division(index, parts.count)


class PupilSteps(DrawnEffect):
    """Smooth wavefronts of each of `count` parts of the pupil as it is drawn, with steps between them."""

    order = -1  # the first of those that act on the drawing, as it joins them
    aberration = True
    parts_of: Callable[[PupilGeometry], Division]  # of a pupil
    # public name of a coefficient of each part: its mode, by Noll index of the whole pupil
    kinds: Mapping[str, int]
    part_name: str  # what error messages call the parts
    sigma_nm: float  # of the prior of each coefficient

    def __init__(self, count: int = UT4_PETALS):
        self.count = count
        self.parameters = tuple(
            Parameter(f"{kind}_{part}", "nm", 0.0, 0.0, self.sigma_nm, plausible=(-1000.0, 1000.0))
            for kind in self.kinds
            for part in range(1, count + 1)
        )

    @classmethod
    def under(cls, conditions: Conditions, *, count: int | None = None) -> PupilSteps:
        """See `Effect.under`; `count`, where given, must be the number of parts."""
        there = cls.parts_of(conditions.settings.geometry).count
        if there < 2:
            raise ValueError(f"the pupil is not divided into {cls.part_name}")
        if count not in (None, there):
            raise ValueError(f"{count} values for {there} {cls.part_name} of the pupil; give as many")
        return cls(there)

    @classmethod
    def options_for(cls, **public: Any) -> dict[str, Any]:
        counts = {len(values) for values in public.values()}
        if len(counts) > 1:
            raise ValueError(
                f"lists of {' and '.join(map(str, sorted(counts)))} values; give as many of each"
            )
        return {"count": counts.pop()} if counts else {}

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect | None:
        """See `Effect.together`: the parts of one drawing, where there is one."""
        redrawn = any(isinstance(one.base, RedrawnPupil) for one in effects)
        return RedrawnAndDivided(effects) if redrawn else None

    @property
    def pistons(self) -> range:
        """Positions of the pistons among the parameters: the first of the kinds."""
        return range(self.count)

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        return _added(field, _parts(type(self), grid, Drawing(grid.geometry)), self.factors(values, grid))

    def slopes(self, values: Tensor, field: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> list[Tensor]:
        return self.moved(values, _parts(type(self), grid, Drawing(grid.geometry)), grid, wanted)

    def opd_nm(self, values: Tensor, grid: PupilGrid) -> Tensor:
        return self.opd_where(values, _index_on(type(self), grid, Drawing(grid.geometry)), grid)

    def factors(self, values: Tensor, grid: PupilGrid) -> list[Tensor]:
        """Return the complex factor of each part at `values` on `grid`, (wavelengths, n, n)."""
        return [grid.phasor(opd) for opd in self._opds_nm(values, grid)]

    def moved(
        self, values: Tensor, amplitudes: Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[Tensor]:
        """Return derivatives of the field by the `wanted` parameters, see `slopes`.

        `amplitudes` (parts, n, n) are those of the parts on `grid`; `values` (parameters,).
        """
        modes = torch.tensor(grid.modes([*self.kinds.values()])) * 1j
        pairs = zip(amplitudes, self.factors(values, grid), strict=True)
        moved = [amplitude * grid.phase_per_nm * factor for amplitude, factor in pairs]
        return [moved[index % self.count] * modes[index // self.count] for index in wanted]

    def opd_where(self, values: Tensor, index: Tensor, grid: PupilGrid) -> Tensor:
        """Return the OPD at `values`, (n, n) [nm]; `index` (n, n): number of the part at points of `grid`."""
        opds = self._opds_nm(values, grid)
        return reduce(torch.add, (torch.where(index == part, opd, 0.0) for part, opd in enumerate(opds)))

    def _opds_nm(self, values: Tensor, grid: PupilGrid) -> list[Tensor]:
        """OPD that each part has, on the whole grid."""
        modes = torch.tensor(grid.modes([*self.kinds.values()]))
        table = values.reshape(len(self.kinds), self.count)
        return [
            sum((table[kind, part] * modes[kind] for kind in range(1, len(modes))), table[0, part] * modes[0])
            for part in range(self.count)
        ]

    def describe(self, values: np.ndarray) -> dict[str, list[float]]:
        table = np.asarray(values, float).reshape(len(self.kinds), self.count)
        return {kind: row.tolist() for kind, row in zip(self.kinds, table, strict=True)}

    def shown(self, values: np.ndarray) -> dict[str, Any]:
        """Differences of the parts from their mean, which the rest of the model imitates, and their RMS."""
        table = np.asarray(values, float).reshape(len(self.kinds), self.count)
        apart = table - table.mean(axis=1, keepdims=True)
        rms = {RMS_OF_PISTON: _rms(apart[:1])} | ({RMS_OF_SLOPES: _rms(apart[1:])} if len(apart) > 1 else {})
        return rms | {f"{kind}_from_mean": row.tolist() for kind, row in zip(self.kinds, apart, strict=True)}

    def differences(self, public: Mapping[str, Any]) -> tuple[float, float]:
        """Return the RMS of the differences in piston, and in tip and tilt [nm], see `Effect.phrase`."""
        values = np.concatenate([public[kind] for kind in self.kinds])
        own = self.shown(values) | {
            key: public[key] for key in (RMS_OF_PISTON, RMS_OF_SLOPES) if key in public
        }
        return own[RMS_OF_PISTON], own.get(RMS_OF_SLOPES, 0.0)

    def values_of(self, **public: Sequence[float]) -> list[float]:
        return [float(value) for kind in self.kinds for value in public[kind]]


def _rms(apart: np.ndarray) -> float:
    """Root of the squares of some coefficients of every part (coefficients, parts), mean over the parts."""
    return float(np.sqrt((apart**2).sum(0).mean()))


def per_part(kinds: Mapping[str, int], unit: str) -> tuple[Public, ...]:
    """Public lists of one number per part for each of the `kinds`, in a `unit`."""
    return tuple(Public(kind, unit, -3000.0, 3000.0, kind="parts") for kind in kinds)


class LowWindEffect(PupilSteps):
    """Differential piston, tip and tilt of the petals between the vanes.

    In calm nights the vanes cool the air beside them, and the wavefront steps from petal to petal by up to
    a micrometre; Shack–Hartmann sensors do not see the steps. Each petal has its piston and, as tip and
    tilt, Noll 2 and 3 of the whole pupil restricted to it. Petals are the connected parts of the clear
    pupil, however many there are, counted anticlockwise from the one nearest to the +45° diagonal; gaps
    between segments do not part them, and they turn with vanes that `pupil_misregistration` turns. Piston of
    the whole pupil does nothing, and common tip and tilt are Noll 2 and 3: the prior decides.
    """

    name = "low_wind_effect"
    formula = "Φ → Φ + Σ_p [piston_p + tip_p Z₂ + tilt_p Z₃] on petal p"
    belongs_to = "moment"
    parts_of = staticmethod(petals_of)
    kinds, part_name, sigma_nm = PISTONS_AND_SLOPES, "petals", 300.0
    public = per_part(PISTONS_AND_SLOPES, "nm, petals anticlockwise from +45°")
    look_alike = "high_order_ncpa, of which every mode takes a part of the steps"
    reference = "Milli et al. 2018, SPIE 10703, 107032A; Sauvage et al. 2016, SPIE 9909, 990916"

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: how much petals differ; what they have in common is no low-wind effect."""
        piston_nm, slopes_nm = self.differences(public)
        return (
            f"petals that differ by {piston_nm:.0f} nm RMS in piston and {slopes_nm:.0f} nm in tip and tilt"
        )


class SegmentPiston(PupilSteps):
    """Piston of the segments of the pupil.

    Segments of a mirror are phased to some tens of nanometres, and sensors that measure slopes do not see
    what is left. Segments are those that the instrument's profile draws, in the order of their numbers; of a
    pupil that is not drawn with segments, the petals, for which the low-wind effect has tip and tilt too.
    Piston of the whole pupil does nothing: the prior decides.
    """

    name = "segment_piston"
    formula = "Φ → Φ + piston_p on segment p"
    parts_of = staticmethod(segments_of)
    kinds, part_name, sigma_nm = PISTONS, "segments", 150.0
    public = per_part(PISTONS, "nm, one per segment")
    look_alike = "high_order_ncpa, of which every mode takes a part of the steps; low_wind_effect"
    reference = "Chanan et al. 1998, Appl. Opt. 37, 140; van Kooten et al. 2022, ApJ 932, 109"

    @classmethod
    def variants(cls, conditions: Conditions) -> tuple[Effect, ...]:
        """See `Effect.variants`: petals alone are left to the low-wind effect."""
        if len(conditions.settings.geometry.segments) < 2:
            raise ValueError("the pupil is not drawn with segments")
        return super().variants(conditions)

    def phrase(self, public: Mapping[str, Any]) -> str:
        return f"segments that differ by {self.differences(public)[0]:.0f} nm RMS in piston"
