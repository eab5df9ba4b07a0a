"""Parts of the pupil out of step: `low_wind_effect` and `segment_piston`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.declaration import Conditions, Parameter, Public
from irlos_pipe.effects.divided_pupil import DividedPupil
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.pupil_division import petals_of, segments_of

UT4_PETALS = 4
PISTONS = {"piston_nm": 1}
PISTONS_AND_SLOPES = {"piston_nm": 1, "tip_nm": 2, "tilt_nm": 3}
RMS_OF_PISTON, RMS_OF_SLOPES = "piston_rms_nm", "slopes_rms_nm"


class PupilSteps(DividedPupil):
    """Smooth wavefronts of each of `count` parts of the pupil, with steps between them."""

    aberration = True
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
        """See `Effect.options_for`: how many parts the values are for."""
        counts = {len(values) for values in public.values()}
        if len(counts) > 1:
            raise ValueError(
                f"lists of {' and '.join(map(str, sorted(counts)))} values; give as many of each"
            )
        return {"count": counts.pop()} if counts else {}

    @property
    def pistons(self) -> range:
        """Positions of the pistons among the parameters: the first of the kinds."""
        return range(self.count)

    def factors(self, values: Tensor, grid: PupilGrid) -> list[Tensor]:
        return [grid.phasor(opd) for opd in self._opds_nm(values, grid)]

    def moved(
        self, values: Tensor, amplitudes: Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[Tensor]:
        modes = torch.tensor(grid.modes([*self.kinds.values()])) * 1j
        pairs = zip(amplitudes, self.factors(values, grid), strict=True)
        moved = [amplitude * grid.phase_per_nm * factor for amplitude, factor in pairs]
        return [moved[index % self.count] * modes[index // self.count] for index in wanted]

    def opd_where(self, values: Tensor, index: Tensor, grid: PupilGrid) -> Tensor:
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
        """One number per part each."""
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
    return tuple(Public(kind, unit, "parts", -3000.0, 3000.0) for kind in kinds)


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
