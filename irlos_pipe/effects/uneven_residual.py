"""`uneven_residual`: the AO residual is stronger in some places of the pupil than in others.

The cone of a laser star misses most of the high layers at the edge of the pupil, and turbulence that the loop
does not know yet enters on the side the wind comes from. With a residual whose variance at x is
``1 + g(x)`` times that of `seeing_halo`, the structure function between x and x + b is
``D(b) + ½ [g(x) + g(x + b)] D_in(b)``: the residual beyond the correction band is that of the turbulence and
everywhere the same. To first order in g the image changes by

    -½ Σ_k g_k ½ (2π/λ)² D_in(b) FFT(∂I/∂a_k)

with ``g = Σ_k g_k Z_k`` and the derivatives of the focal intensity I by the same modes of the logarithm of
the amplitude, behind the OTF of everything else. D_in is that expected at the seeing. At the edges of the
pupil, where g is largest, the second order is some per cent of the OTF.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.declaration import Conditions, Parameter, number
from irlos_pipe.effects.planes import OtfEffect
from irlos_pipe.effects.seeing_halo import SeeingHalo, require_residual
from irlos_pipe.optics.fourier_matrices import FocalGrid
from irlos_pipe.optics.grids import OtfGrid, PupilMode
from irlos_pipe.optics.residual_otf import per_nm2, residual_otf
from irlos_pipe.optics.structure_function import ResidualBand

NOLLS = {"edge": 4, "side_x": 2, "side_y": 3}
LARGEST = 0.55  # nowhere less variance than none: Noll 4 is -√3 at the centre


class UnevenResidual(OtfEffect):
    """The AO residual is stronger at the edge of the pupil, or on one side of it.

    Values are those of Noll 4, 2 and 3 in the variance of the residual inside the correction band, as parts
    of the variance that is expected at the seeing.

    Parameters
    ----------
    law : ResidualLaw
        AO residual against seeing.
    """

    name = "uneven_residual"
    formula = "D(x, x + b) = D(b) + ½ [g(x) + g(x + b)] D_in(b); g = edge Z_4 + side_x Z_2 + side_y Z_3"
    belongs_to = "moment"
    public = tuple(
        number(name, f"of the variance, Noll {noll}", -LARGEST, LARGEST, required=False)
        for name, noll in NOLLS.items()
    )
    parameters = tuple(
        Parameter(name, "", 0.0, 0.0, 0.2, -LARGEST, LARGEST, plausible=(-LARGEST, LARGEST)) for name in NOLLS
    )
    look_alike = "amplitude_aberration, which takes light away for good; the residual's goes to the halo"
    reference = "Véran et al. 1997, JOSA A 14, 3057; Fried & Belsher 1994, JOSA A 11, 277 (cone effect)"

    def __init__(self, band: ResidualBand, law: ResidualLaw, seeing_arcsec: float):
        self._residual = band, law, seeing_arcsec

    @classmethod
    def under(cls, conditions: Conditions) -> UnevenResidual:
        """See `Effect.under`: it means nothing on a bench without atmosphere."""
        require_residual(conditions)
        return cls(conditions.band, conditions.residual_law, conditions.seeing_arcsec)

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """See `Effect.seen_in`: parts of what is expected here."""
        return UnevenResidual.under(here)

    @property
    def further_paths(self) -> Sequence[tuple[PupilMode | None, Effect]]:
        return [(PupilMode(noll, of_amplitude=True), _Part(self, i)) for i, noll in enumerate(NOLLS.values())]

    def phrase(self, public: Mapping[str, Any]) -> str:
        edge, side = public["edge"], float(np.hypot(public["side_x"], public["side_y"]))
        where = "at the edge" if edge > 0 else "in the middle"
        return (
            f"an AO residual that is stronger {where} of the pupil ({abs(edge):.0%} RMS of its variance), "
            f"and by {side:.0%} on one side"
        )

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        """See `OtfEffect.apply`: all of it is in `further_paths`."""
        return factor

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        return [torch.zeros_like(factor)] * len(wanted)

    def share(self, grid: OtfGrid) -> Tensor:
        """Return ``-½ ½ (2π/λ)² D_in(b)``, (wavelengths, p, p//2 + 1)."""
        return -0.25 * per_nm2(grid) * _in_band_nm2(*self._residual, grid.focal)


class _Part(OtfEffect):
    """The factor of the derivative by the mode at a `place` in `uneven`, whose parameters it has."""

    name = UnevenResidual.name

    def __init__(self, uneven: UnevenResidual, place: int):
        self.uneven, self.place, self.parameters = uneven, place, uneven.parameters

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        return factor * values[self.place] * self.uneven.share(grid)

    def slopes(self, values: Tensor, factor: Tensor, grid: OtfGrid, wanted: Sequence[int]) -> list[Tensor]:
        own = factor * self.uneven.share(grid)
        return [own if index == self.place else torch.zeros_like(own) for index in wanted]


@lru_cache(maxsize=4)
def _in_band_nm2(band: ResidualBand, law: ResidualLaw, seeing_arcsec: float, focal: FocalGrid) -> Tensor:
    """Structure function inside the band that is expected at the seeing, (p, p//2 + 1) [nm²]."""
    halo = SeeingHalo(band, law, seeing_arcsec)
    expected = torch.tensor([p.start for p in halo.parameters], dtype=torch.float64)
    return residual_otf(band, halo.r0_m, focal).structure_nm2(expected, 0.0)
