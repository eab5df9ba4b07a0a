"""All effects of a model together, as a function of one parameter vector."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from itertools import pairwise
from typing import get_args

import numpy as np
import torch

from irlos_pipe.effects.base import Effect, FixedEffect
from irlos_pipe.effects.declaration import Parameter, Plane
from irlos_pipe.optics.grids import Grids, Optics, OtfGrid, Sampling, Tangents

PLANES = get_args(Plane)
NOTHING = torch.zeros(0, dtype=torch.float64)


class EffectSet:
    """Effects in the order of the light path, and the parameter vector they share.

    Parameters
    ----------
    effects : sequence of Effect
        In any order; parameters come in the order of `effects` of this object.
    grids : Grids
        Of the `PsfModel` whose light path they act on.
    """

    def __init__(self, effects: Sequence[Effect], grids: Grids):
        self.effects = tuple(sorted(effects, key=lambda e: (PLANES.index(e.plane), e.order)))
        self.grids = grids
        ends = np.cumsum([0, *(len(effect.parameters) for effect in self.effects)])
        self._pieces = [slice(int(a), int(b)) for a, b in pairwise(ends)]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Free parameters of all effects in order."""
        return tuple(parameter for effect in self.effects for parameter in effect.parameters)

    def at(self, plane: Plane) -> list[tuple[Effect, slice]]:
        """Effects at one plane with their parts of the parameter vector."""
        pairs = zip(self.effects, self._pieces, strict=True)
        return [(effect, piece) for effect, piece in pairs if effect.plane == plane]

    def free_at(self, plane: Plane) -> list[int]:
        """Positions in the parameter vector of the parameters at one plane."""
        return [i for _, piece in self.at(plane) for i in range(piece.start, piece.stop)]

    @property
    def starts(self) -> torch.Tensor:
        """Where a fit begins."""
        return torch.tensor([p.start for p in self.parameters], dtype=torch.float64)

    # -- light path --------------------------------------------------------------------------

    def __call__(self, values: torch.Tensor = NOTHING) -> Optics:
        """What the effects make of pupil, OTF and sampling."""
        sampling = self._sampling(values)
        return Optics(
            self._pupil(values, sampling) if self.at("pupil") else None,
            self._transfer(values, sampling) if self.at("otf") else None,
            sampling if self.at("sampling") else None,
        )

    def tangents(self, values: torch.Tensor) -> Tangents:
        """Derivatives of pupil and OTF factors with respect to the parameters at these planes."""
        sampling = self._sampling(values)
        return Tangents(self._pupil_slopes(values, sampling), self._transfer_derivatives(values, sampling))

    def modes_at(self, values: torch.Tensor, modes_nm: torch.Tensor, when: torch.Tensor) -> torch.Tensor:
        """Coefficients at the times `when` of the recording, see `TimeEffect.apply`."""
        nolls = self.grids.nolls
        return reduce(lambda x, e: e[0].apply(values[e[1]], x, nolls, when), self.at("time"), modes_nm)

    def detect(self, values: torch.Tensor, images_e: torch.Tensor) -> torch.Tensor:
        """Electrons in the pixels as the detector shows them."""
        return reduce(lambda x, e: e[0].apply(values[e[1]], x), self.at("detector"), images_e)

    def opd_nm(self, values: torch.Tensor) -> torch.Tensor:
        """Part of the wavefront that effects in the pupil add, (n, n) [nm]."""
        grid = self.grids.pupil
        maps = [effect.opd_nm(values[piece], grid) for effect, piece in self.at("pupil")]
        nothing = torch.zeros(len(grid.u_m), len(grid.u_m), dtype=torch.float64)
        return sum((opd for opd in maps if opd is not None), nothing)

    def _sampling(self, values: torch.Tensor) -> Sampling:
        nominal = self.grids.sampling
        return reduce(lambda s, e: e[0].apply(values[e[1]], s, nominal), self.at("sampling"), nominal)

    def _pupil(self, values: torch.Tensor, sampling: Sampling) -> torch.Tensor:
        grid = self.grids.pupil.at(sampling.wavelengths_m)
        clear = torch.as_tensor(grid.amplitude, dtype=torch.complex128).expand(len(sampling.weights), -1, -1)
        return reduce(lambda field, e: e[0].apply(values[e[1]], field, grid), self.at("pupil"), clear)

    def _pupil_slopes(self, values: torch.Tensor, sampling: Sampling) -> list[torch.Tensor]:
        """Each effect's own derivatives, as the effects behind it leave them."""
        if not self.free_at("pupil"):
            return []
        grid = self.grids.pupil.at(sampling.wavelengths_m)
        dark = torch.zeros(len(sampling.weights), *grid.amplitude.shape, dtype=torch.complex128)
        field, slopes = dark + torch.as_tensor(grid.amplitude), []
        for effect, piece in self.at("pupil"):
            own = values[piece]
            if slopes:
                added = effect.apply(own, dark, grid)
                slopes = [effect.apply(own, slope, grid) - added for slope in slopes]
            slopes += effect.slopes(own, field, grid, range(len(effect.parameters)))
            field = effect.apply(own, field, grid)
        return slopes

    def _transfer(self, values: torch.Tensor, sampling: Sampling) -> torch.Tensor:
        grid = OtfGrid.of(self.grids.focal, sampling)
        return reduce(lambda f, e: e[0].apply(values[e[1]], f, grid), self.at("otf"), _clear_factor(grid))

    def _transfer_derivatives(self, values: torch.Tensor, sampling: Sampling) -> list[torch.Tensor]:
        """Each factor's own derivatives times the factors of the others."""
        pairs = self.at("otf")
        if not self.free_at("otf"):
            return []
        grid, changes = OtfGrid.of(self.grids.focal, sampling), []
        clear = _clear_factor(grid)
        factors = [effect.apply(values[piece], clear, grid) for effect, piece in pairs]
        for number, (effect, piece) in enumerate(pairs):
            if effect.parameters:
                others = reduce(torch.mul, factors[:number] + factors[number + 1 :], torch.ones(()))
                own = effect.slopes(values[piece], clear, grid, range(len(effect.parameters)))
                changes += [others * slope for slope in own]
        return changes

    # -- bookkeeping -------------------------------------------------------------------------

    def split(self, values) -> dict[str, np.ndarray]:
        """The parameter vector cut into one piece per effect, by effect name."""
        pairs = zip(self.effects, self._pieces, strict=True)
        return {effect.name: np.asarray(values[piece], float) for effect, piece in pairs}

    def describe(self, values) -> dict[str, dict]:
        """Public parameters of every effect, by effect name."""
        pieces = self.split(values)
        return {effect.name: effect.describe(pieces[effect.name]) for effect in self.effects}

    def held(self, values: torch.Tensor) -> EffectSet:
        """The same effects, nothing free, at `values`."""
        pairs = zip(self.effects, self._pieces, strict=True)
        return EffectSet([_held(effect, values[piece]) for effect, piece in pairs], self.grids)

    def held_but(self, values: torch.Tensor, index: int) -> tuple[EffectSet, slice]:
        """The same but for the effect with one parameter, and that effect's part of `values`."""
        own = next(piece for piece in self._pieces if piece.start <= index < piece.stop)
        pairs = zip(self.effects, self._pieces, strict=True)
        held = [e if piece == own else _held(e, values[piece]) for e, piece in pairs]
        return EffectSet(held, self.grids), own


def _clear_factor(grid: OtfGrid) -> torch.Tensor:
    """OTF factor of nothing, (wavelengths, p, p//2 + 1)."""
    return torch.ones(len(grid.wavelengths_m), *grid.length2_m2.shape, dtype=torch.float64)


def _held(effect: Effect, values: torch.Tensor) -> FixedEffect:
    return FixedEffect(effect.base, effect.all_values(values).numpy())


def fixed_optics(effects: Sequence[Effect], grids: Grids) -> Optics:
    """What `effects` without free parameters make of the light path with these `grids`."""
    return EffectSet(effects, grids)()
