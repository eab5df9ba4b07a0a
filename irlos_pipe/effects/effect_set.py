"""All effects of a model together, as a function of one parameter vector."""

from collections.abc import Sequence
from functools import cached_property, reduce
from itertools import groupby, pairwise
from typing import Any, get_args

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.base import Effect, FixedEffect, labels_of
from irlos_pipe.effects.declaration import Parameter, Plane
from irlos_pipe.numerics.directional import along_all
from irlos_pipe.optics.grids import Change, Grids, Optics, OtfGrid, PupilMode, Sampling, Tangents

PLANES: tuple[Plane, ...] = get_args(Plane)
Acting = tuple[Any, slice]  # an effect of some plane, and its part of the parameter vector

# Steps of central differences, which err by their square and by rounding over them: of a parameter, and of
# the sampling, relative: quicker than automatic differentiation through the AO residual.
SMALL, DIFFERENCE = 1e-6, 1e-4


def _slope(above: Tensor | None, below: Tensor | None, step: float) -> Tensor | None:
    """Central difference; None of what does not change."""
    if above is None or below is None or torch.equal(above, below):
        return None
    return (above - below) / (2 * step)


class EffectSet:
    """Effects in the order of the light path, and the parameter vector they share.

    They may be given in any order; parameters come in the order of `effects` of this object. The `grids` are
    those of the light path on which they act.
    """

    def __init__(self, effects: Sequence[Effect], grids: Grids):
        kinds = list(dict.fromkeys(effect.name for effect in effects))
        self.effects = tuple(
            sorted(effects, key=lambda e: (PLANES.index(e.plane), e.order, kinds.index(e.name)))
        )
        self.grids = grids
        ends = np.cumsum([0, *(len(effect.parameters) for effect in self.effects)])
        self._pieces = [slice(int(a), int(b)) for a, b in pairwise(ends)]

    @cached_property
    def _acting(self) -> list[Acting]:
        """The effects one after the other with their parts of the parameter vector, some kinds as one."""
        pairs = zip(self.effects, self._pieces, strict=True)
        acting: list[Acting] = []
        for _, group in groupby(pairs, key=lambda pair: pair[0].joins or pair[0].name):
            same, pieces = zip(*group, strict=True)
            joined = type(same[0].base).together(same) if len(same) > 1 else None
            if joined is None:
                acting += zip(same, pieces, strict=True)
            else:
                acting.append((joined, slice(pieces[0].start, pieces[-1].stop)))
        return acting

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Free parameters of all effects in order."""
        return tuple(parameter for effect in self.effects for parameter in effect.parameters)

    def at(self, plane: Plane) -> list[Acting]:
        """Effects at one plane with their parts of the parameter vector."""
        return [pair for pair in self._acting if pair[0].plane == plane]

    def free_at(self, plane: Plane) -> list[int]:
        """Positions in the parameter vector of the parameters at one plane."""
        return [i for _, piece in self.at(plane) for i in range(piece.start, piece.stop)]

    @property
    def starts(self) -> Tensor:
        """Where a fit begins."""
        return torch.tensor([p.start for p in self.parameters], dtype=torch.float64)

    # -- light path --------------------------------------------------------------------------

    def __call__(self, values: Tensor | None = None) -> Optics:
        """What the effects make of pupil, OTF and sampling; without `values` if all are held."""
        values = torch.zeros(0, dtype=torch.float64) if values is None else values
        return self._optics(values, self._sampling(values))

    def _optics(self, values: Tensor, sampling: Sampling) -> Optics:
        """The same for a `sampling` that the effects may not make."""
        star = Optics(
            self._pupil(values, sampling) if self.at("pupil") else None,
            self._transfer(values, sampling, self.at("otf")) if self.at("otf") else None,
            sampling if self.at("sampling") else None,
            by_mode=tuple((mode, self._transfer(values, sampling, path)) for mode, path in self._by_mode),
        )
        copies = (self._copied(values, sampling, star, path) for path in self._copies)
        return star._replace(copies=tuple(copies))

    def tangents(self, values: Tensor) -> Tangents:
        """Derivatives of pupil, OTF factors and sampling with respect to the parameters at these planes."""
        sampling = self._sampling(values)
        transfer = self._transfer_derivatives(values, sampling, self.at("otf"))
        by_mode = [self._transfer_derivatives(values, sampling, path) for _, path in self._by_mode]
        star = Tangents(self._pupil_slopes(values, sampling), transfer, by_mode=by_mode)
        copies = [self._copied_tangents(values, sampling, star, path) for path in self._copies]
        every = [self._resampled(values, index) for index in self.free_at("sampling")]
        star, *copies = (
            path._replace(sampling=[changes[number] for changes in every])
            for number, path in enumerate([star, *copies])
        )
        return star._replace(copies=tuple(copies))

    def _resampled(self, values: Tensor, index: int) -> list[Change]:
        """Derivatives for star and copies with respect to the parameter `index`, one of the sampling."""
        sampling, move = self._sampling(values), torch.zeros_like(values)
        move[index] = SMALL * max(1.0, abs(float(values[index])))
        ends = zip(sampling, self._sampling(values + move), self._sampling(values - move), strict=True)
        change = Sampling(*((above - below + 0 * one) / (2 * move[index]) for one, above, below in ends))

        def light(along: float) -> list[Tensor | None]:
            pairs = zip(sampling, change, strict=True)
            star = self._optics(values, Sampling(*(one + along * rate for one, rate in pairs)))
            return [factor for path in (star, *star.copies) for factor in (path.pupil, path.transfer)]

        if not (change.wavelengths_m.any() or change.weights.any()):
            return [(None, None, change) for _ in range(1 + len(self._copies))]
        colours = (change.wavelengths_m / sampling.wavelengths_m, change.weights / sampling.weights)
        largest = max(float(rate.abs().max()) for rate in colours)
        step = DIFFERENCE / largest
        factors = [_slope(*ends, step) for ends in zip(light(step), light(-step), strict=True)]
        return [
            (pupil, transfer, change) for pupil, transfer in zip(factors[0::2], factors[1::2], strict=True)
        ]

    def modes_at(self, values: Tensor, modes_nm: Tensor, when: Tensor) -> Tensor:
        """Coefficients `modes_nm` with the effects at `values`, at times `when`, see `TimeEffect.apply`."""
        nolls = self.grids.nolls
        return reduce(lambda x, e: e[0].apply(values[e[1]], x, nolls, when), self.at("time"), modes_nm)

    def detect(self, values: Tensor, images_e: Tensor) -> Tensor:
        """Electrons `images_e` in the pixels as the detector shows them with the effects at `values`."""
        return reduce(lambda x, e: e[0].apply(values[e[1]], x), self.at("detector"), images_e)

    def detect_with_changes(self, values: Tensor, images_e: Tensor, changes: Tensor) -> tuple[Tensor, Tensor]:
        """The same, and what small `changes` (images, changes, rows, columns) of the images become."""
        for effect, piece in self.at("detector"):
            changes = effect.pushed(values[piece], images_e, changes)
            images_e = effect.apply(values[piece], images_e)
        return images_e, changes

    def opd_nm(self, values: Tensor) -> Tensor:
        """Part of the wavefront that effects in the pupil add, (n, n) [nm]."""
        grid = self.grids.pupil
        maps = [effect.opd_nm(values[piece], grid) for effect, piece in self.at("pupil")]
        nothing = torch.zeros(len(grid.u_m), len(grid.u_m), dtype=torch.float64)
        return sum((opd for opd in maps if opd is not None), nothing)

    def _sampling(self, values: Tensor) -> Sampling:
        nominal = self.grids.sampling
        return reduce(lambda s, e: e[0].apply(values[e[1]], s, nominal), self.at("sampling"), nominal)

    def _pupil(self, values: Tensor, sampling: Sampling) -> Tensor:
        grid = self.grids.pupil.at(sampling.wavelengths_m)
        clear = torch.as_tensor(grid.amplitude, dtype=torch.complex128).expand(len(sampling.weights), -1, -1)
        return reduce(lambda field, e: e[0].apply(values[e[1]], field, grid), self.at("pupil"), clear)

    def _pupil_slopes(self, values: Tensor, sampling: Sampling) -> list[Tensor]:
        """Each effect's own derivatives, as the effects behind it leave them."""
        if not self.free_at("pupil"):
            return []
        grid = self.grids.pupil.at(sampling.wavelengths_m)
        dark = torch.zeros(len(sampling.weights), *grid.amplitude.shape, dtype=torch.complex128)
        field = dark + torch.as_tensor(grid.amplitude)
        slopes: list[Tensor] = []
        for effect, piece in self.at("pupil"):
            own = values[piece]
            if slopes:
                added = effect.apply(own, dark, grid)
                slopes = [effect.apply(own, slope, grid) - added for slope in slopes]
            slopes += effect.slopes(own, field, grid, range(len(effect.parameters)))
            field = effect.apply(own, field, grid)
        return slopes

    def _transfer(self, values: Tensor, sampling: Sampling, pairs: Sequence[Acting]) -> Tensor:
        """Product of the factors of `pairs` of effects."""
        grid = OtfGrid.of(self.grids.focal, sampling)
        return reduce(lambda f, e: e[0].apply(values[e[1]], f, grid), pairs, _clear_factor(grid))

    def _transfer_derivatives(
        self, values: Tensor, sampling: Sampling, pairs: Sequence[Acting]
    ) -> list[Tensor]:
        """Own derivatives of the factor of every effect in `pairs` times the factors of the others."""
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

    @cached_property
    def _further_paths(self) -> list[tuple[PupilMode | None, list[Acting], Acting]]:
        """Modes of further light paths, their effects of the OTF, and the one among these that makes them."""
        pairs = self.at("otf")
        return [
            (mode, [*pairs[:place], (one, piece), *pairs[place + 1 :]], (one, piece))
            for place, (effect, piece) in enumerate(pairs)
            for mode, one in effect.further_paths
        ]

    @property
    def _by_mode(self) -> list[tuple[PupilMode, list[Acting]]]:
        """Modes of `Optics.by_mode`, and the effects on their OTF factors."""
        return [(mode, path) for mode, path, _ in self._further_paths if mode]

    # -- copies of the star ------------------------------------------------------------------

    @property
    def _copies(self) -> list[tuple[list[Acting], Acting]]:
        """Effects of the OTF on the light path of every copy of the star, and the copy itself among them."""
        return [(path, copy) for mode, path, copy in self._further_paths if not mode]

    def defocus_nm(self, values: Tensor) -> list[Tensor]:
        """Defocus of every copy of the star beyond that of the star, scalars [nm RMS]."""
        return [copy.defocus_nm(values[piece]) for _, (copy, piece) in self._copies]

    def _copied(self, values: Tensor, sampling: Sampling, star: Optics, path) -> Optics:
        """The light path of a copy next to that of the `star`."""
        pairs, (copy, piece) = path
        pupil = self._pupil(values, sampling) if star.pupil is None else star.pupil
        shifted = pupil * self._shift(sampling, copy.defocus_nm(values[piece]))
        return Optics(shifted, self._transfer(values, sampling, pairs), star.sampling)

    def _copied_tangents(self, values: Tensor, sampling: Sampling, star: Tangents, path) -> Tangents:
        """Derivatives of `_copied`; of the star they are `star`."""
        pairs, (copy, piece) = path
        shift = self._shift(sampling, copy.defocus_nm(values[piece]))
        slopes = [slope * shift for slope in star.pupil]
        transfer = self._transfer_derivatives(values, sampling, pairs)
        if not copy.parameters:
            return Tangents(slopes, transfer)
        grid = self.grids.pupil.at(sampling.wavelengths_m)
        turned = 1j * grid.phase_per_nm * self._defocus * self._pupil(values, sampling) * shift
        rates = along_all(copy.defocus_nm, values[piece])
        first = piece.start - self.free_at("otf")[0]
        by_place = [(first + i, rate * turned) for i, rate in enumerate(rates) if rate]
        return Tangents(slopes, transfer, by_place)

    def _shift(self, sampling: Sampling, defocus_nm: Tensor) -> Tensor:
        """Factor of the field by which its focus changes, (wavelengths, n, n)."""
        return self.grids.pupil.at(sampling.wavelengths_m).phasor(defocus_nm * self._defocus)

    @property
    def _defocus(self) -> Tensor:
        return torch.tensor(self.grids.pupil.modes([DEFOCUS])[0])

    # -- bookkeeping -------------------------------------------------------------------------

    @property
    def labels(self) -> list[str]:
        """Unique labels of the effects, see `labels_of`."""
        return labels_of(self.effects)

    def pieces(self, values: Tensor) -> list[np.ndarray]:
        """The parameter vector cut into one piece per effect."""
        return [np.asarray(values[piece], float) for piece in self._pieces]

    def columns_in(self, moment: int) -> list[int]:
        """Positions in the parameter vector of the parameters of effects that act in a `moment`."""
        pairs = zip(self.effects, self._pieces, strict=True)
        return [i for effect, piece in pairs if effect.acting(moment) for i in range(piece.start, piece.stop)]

    def columns_of(self, label: str) -> range:
        """Positions of an effect's parameters in the parameter vector, by `label`."""
        piece = self._pieces[self.labels.index(label)]
        return range(piece.start, piece.stop)

    def split(self, values: Tensor) -> dict[str, np.ndarray]:
        """The parameter vector cut into one piece per effect, by label."""
        return dict(zip(self.labels, self.pieces(values), strict=True))

    def describe(self, values: Tensor) -> dict[str, dict[str, Any]]:
        """Public parameters of every effect, by label."""
        pairs = zip(self.effects, self.pieces(values), strict=True)
        return dict(zip(self.labels, (effect.describe(piece) for effect, piece in pairs), strict=True))

    def held(self, values: Tensor) -> "EffectSet":
        """The effects with all parameters held at `values`."""
        pairs = zip(self.effects, self._pieces, strict=True)
        return EffectSet([_held(effect, values[piece]) for effect, piece in pairs], self.grids)

    def held_but(self, values: Tensor, index: int) -> "tuple[EffectSet, slice]":
        """The effects held at `values` except the one that has the parameter `index`, and its part of
        `values`.
        """
        own = next(piece for piece in self._pieces if piece.start <= index < piece.stop)
        pairs = zip(self.effects, self._pieces, strict=True)
        held = [e if piece == own else _held(e, values[piece]) for e, piece in pairs]
        return EffectSet(held, self.grids), own


def _clear_factor(grid: OtfGrid) -> Tensor:
    """OTF factor of nothing, (wavelengths, p, p//2 + 1)."""
    return torch.ones(len(grid.wavelengths_m), *grid.length2_m2.shape, dtype=torch.float64)


def _held(effect: Effect, values: Tensor) -> FixedEffect:
    return FixedEffect(effect.base, effect.all_values(values).numpy())


def fixed_optics(effects: Sequence[Effect], grids: Grids) -> Optics:
    """What `effects` without free parameters make of the light path with these `grids`."""
    return EffectSet(effects, grids)()
