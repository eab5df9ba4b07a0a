"""`low_wind_effect`: petals of the pupil out of step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.pupil_drawing import PETALS
from irlos_pipe.effects.declaration import Parameter, Public
from irlos_pipe.effects.planes import PupilEffect
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.petals import petal_amplitudes, petal_index

KINDS, KIND_NOLLS = ("piston_nm", "tip_nm", "tilt_nm"), (1, 2, 3)
PETAL_SIGMA_NM = 300.0


class LowWindEffect(PupilEffect):
    """Differential piston, tip and tilt of the petals between the vanes.

    In calm nights the vanes cool the air beside them, and the wavefront steps from petal to petal by up to
    a micrometre; Shack–Hartmann sensors do not see the steps. Each petal has its piston and, as tip and
    tilt, Noll 2 and 3 of the whole pupil restricted to it. The field is the sum of the petals' fields, each
    with its own band-limited amplitude: a step within a vane needs no finer grid than the vane itself.
    Piston of the whole pupil does nothing, and common tip and tilt are Noll 2 and 3: the prior decides.
    """

    name = "low_wind_effect"
    aberration = True
    order = 0  # adds to the field, before what multiplies it
    public = tuple(
        Public(kind, "nm, petals anticlockwise from +45°", "petals", -3000.0, 3000.0) for kind in KINDS
    )
    look_alike = "high_order_ncpa, of which every mode takes a part of the steps"
    reference = "Milli et al. 2018, SPIE 10703, 107032A; Sauvage et al. 2016, SPIE 9909, 990916"
    parameters = tuple(
        Parameter(f"{kind}_{petal}", "nm", 0.0, 0.0, PETAL_SIGMA_NM, plausible=(-1000.0, 1000.0))
        for kind in KINDS
        for petal in range(1, PETALS + 1)
    )

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """See `PupilEffect.apply`."""
        for amplitude, opd in zip(self._petals(grid), self._petal_opds_nm(values, grid), strict=True):
            field = field + torch.as_tensor(amplitude) * (grid.phasor(opd) - 1)
        return field

    def slopes(
        self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """See `PupilEffect.slopes`."""
        kinds = torch.tensor(grid.modes(KIND_NOLLS)) * 1j
        opds = self._petal_opds_nm(values, grid)
        turned = [
            torch.as_tensor(amplitude) * grid.phase_per_nm * grid.phasor(opd)
            for amplitude, opd in zip(self._petals(grid), opds, strict=True)
        ]
        return [turned[index % PETALS] * kinds[index // PETALS] for index in wanted]

    def opd_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """See `PupilEffect.opd_nm`."""
        index = torch.as_tensor(petal_index(grid.geometry, *(axis * grid.radius_m for axis in grid.xy)))
        opds = self._petal_opds_nm(values, grid)
        return reduce(torch.add, (torch.where(index == petal, opd, 0.0) for petal, opd in enumerate(opds)))

    def _petals(self, grid: PupilGrid) -> np.ndarray:
        """Amplitude of each petal, (petals, n, n)."""
        return np.where(grid.lit, petal_amplitudes(grid.geometry, grid.samples), 0) * grid.light

    def _petal_opds_nm(self, values: torch.Tensor, grid: PupilGrid) -> list[torch.Tensor]:
        """OPD that each petal has, on the whole grid."""
        one, tip, tilt = torch.tensor(grid.modes(KIND_NOLLS))
        pistons, tips, tilts = values.reshape(len(KINDS), PETALS)
        return [pistons[i] * one + tips[i] * tip + tilts[i] * tilt for i in range(PETALS)]

    def describe(self, values: np.ndarray) -> dict[str, list[float]]:
        """Four numbers each."""
        table = np.asarray(values, float).reshape(len(KINDS), PETALS)
        return {kind: row.tolist() for kind, row in zip(KINDS, table, strict=True)}

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: how much petals differ; what they have in common is no low-wind effect."""
        piston_nm, tip_nm, tilt_nm = (np.std(public[kind]) for kind in KINDS)
        differ = f"{piston_nm:.0f} nm RMS in piston and {np.hypot(tip_nm, tilt_nm):.0f} nm in tip and tilt"
        return f"petals that differ by {differ}"

    def values_of(
        self, piston_nm: Sequence[float], tip_nm: Sequence[float], tilt_nm: Sequence[float]
    ) -> list[float]:
        """See `Effect.values_of`."""
        return [float(value) for kind in (piston_nm, tip_nm, tilt_nm) for value in kind]
