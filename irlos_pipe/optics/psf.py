"""The forward model: from wavefront coefficients to a pixel-integrated, unit-flux image.

One pass along the light path, shapes ``(frame, wavelength, y, x)``::

    field      E = P exp(2πi Φ/λ)                    pupil: petals, stops, static maps
    amplitude  U = F E Fᵀ                            focal grid, pitch λ/2D'
    intensity  I = |U|² / ∫|P|²                      unit total flux
    OTF        O = FFT(I) · T(λ)                     AO residual, motion, companion, dispersion
    image      Σ_λ w(λ) G(λ) O G(λ)ᵀ                 exactly the detector's pixels: colours, plate scale

A copy of the star that has a wavefront of its own, such as a ghost out of focus, goes along a second path
like this one, and both images add. Where an effect in the plane of the OTF asks for it, ``T_k FFT(∂I/∂a_k)``
adds to O for some modes k; derivatives by pupil and sampling leave out how that sum changes with them, as it
is some per cent of the light.
What physical effects make of P, T, and of the sampling (λ, w, pixel scale in G) arrives as one
`Optics`. Flux, background and the detector follow in `image_model`. Derivatives are hand-written:
``∂I/∂a_k = -(4π/λ) Im(U* F[Z_k E])``, and because a Zernike polynomial of degree n is a sum of
products T_a(x) T_b(y), a + b ≤ n, the transform along x is shared by all modes. The transforms themselves
are those of `optics.fourier_matrices`, where fields are real arrays ``(frame, 2, y, x)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial, reduce
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.polynomial import chebyshev

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.units import NM
from irlos_pipe.numerics.parallel import at_once, ordered_map
from irlos_pipe.optics.defocus import defocus_series, shaped_modes
from irlos_pipe.optics.fourier_matrices import MatrixDft, mirrored, products_up_to
from irlos_pipe.optics.grids import Grids, Optics, PupilGrid, Sampling, Tangents
from irlos_pipe.optics.light_path import AS_BUILT, NO_TANGENTS, Pullback
from irlos_pipe.optics.monochromatic import (
    COMPLEX,
    ByMode,
    Colour,
    FocalPlane,
    Rates,
    amplitudes,
    amplitudes_of,
    beat_of,
    behind,
    by_phase,
    change_of,
    intensity_of,
    resampled,
    turned_fields,
)
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.zernike import in_products, noll_to_nm

FAINT = 0.1  # share of the light below which the derivatives of a copy may be rough
COLOURS_KEPT = 16  # light paths at one wavelength that are kept as they are
CHUNK_ELEMENTS = 6_000_000  # complex numbers held per batch of frames
# Zernike modes of high degree have huge coefficients of either sign in products of polynomials. In float32
# their derivatives err by 1e-3 at degree 10 (Noll 66), by a tenth at 13, and by many times their size at 20.
SINGLE_DEGREE = 10
SLOPES_AT_ONCE = 8  # changes of the pupil times frames: they fit into the processor's cache


class PsfModel:
    """A `LightPath` by propagation, with the Zernike modes `nolls`.

    The propagation has the precision `dtype`, float32 or float64; sums over pixels are left to the caller, in
    float64. Modes of a degree above `SINGLE_DEGREE` have float64 whatever `dtype` is. The `grid` may be that
    of a part of the pupil, if no other light makes the image; light is counted of the whole pupil.

    With `rough_derivatives` those of the modes, from the focal plane to the pixels, have float32 whatever
    `dtype` is: this halves their cost, and they are exact to 1e-6 of the largest. Faint copies of the star
    change with modes and pupil as the star does, as if they were as sharp, which spares each the cost of
    another star; this is wrong by a part of their flux. How what `Optics.by_mode` adds changes with modes is
    left out, which is wrong by some per cent of a derivative.
    """

    def __init__(
        self,
        settings: PsfSettings,
        nolls: Sequence[int],
        *,
        device: str = "cpu",
        dtype: torch.dtype = torch.float32,
        rough_derivatives: bool = False,
        grid: PupilGrid | None = None,
    ):
        self.settings, self.nolls, self.device = settings, tuple(nolls), device
        high = any(noll_to_nm(noll)[0] > SINGLE_DEGREE for noll in nolls)
        self.dtype = torch.float64 if high else dtype
        self.rough_derivatives = rough_derivatives
        wavelengths, weights = np.array(settings.spectrum, float).T
        self.wavelengths_m = wavelengths * NM
        self.weights = weights / weights.sum()
        self.colours: Sequence[int] = range(len(self.weights))  # those whose light is propagated
        self.pupil_grid = pupil_grid(settings) if grid is None else grid
        self.amplitude = self._map(self.pupil_grid.amplitude)
        known = settings.known.total_nm
        modes, of_known = (
            shaped_modes(self.pupil_grid, some, settings.focus_sine) for some in (nolls, [*known])
        )
        self.basis = self._map(modes).flatten(1)
        self.known_nm = self._map(np.tensordot(np.array([*known.values()]), of_known, 1))
        self._set_products(self.pupil_grid)
        self.focal_plane = self._focal_plane(settings)
        self._colours: dict[tuple[int, int], tuple[Optics, Colour]] = {}

    @property
    def grids(self) -> Grids:
        return Grids(self.pupil_grid, self.focal_plane.widest, self._sampling(), self.nolls)

    def in_window(self, window: tuple[int, int], margin_mas: float, halo_margin_mas: float) -> PsfModel:
        other = copy(self)
        other.settings = replace(
            self.settings, window=window, margin_mas=margin_mas, halo_margin_mas=halo_margin_mas
        )
        other.focal_plane, other._colours = self._focal_plane(other.settings), {}
        return other

    def coarse(self, optics: Optics) -> tuple[PsfModel, Optics]:
        """Return what stands for `optics`: every third wavelength, without what `Optics.by_mode` adds."""
        other, count = copy(self), len(self.weights)
        other.colours = range(min(1, count - 1), count, 3)
        sampling = optics.sampling or self.grids.sampling
        sampling = sampling._replace(weights=sampling.weights / sampling.weights[[*other.colours]].sum())
        copies = tuple(one._replace(sampling=sampling) for one in optics.copies)
        return other, optics._replace(sampling=sampling, copies=copies, by_mode=())

    @property
    def limits_nm(self) -> torch.Tensor:
        """See `LightPath.limits_nm`: there are none."""
        infinite = torch.full((len(self.nolls),), float("inf"), dtype=torch.float64)
        return torch.stack([-infinite, infinite])

    # -- construction ------------------------------------------------------------------------

    def _sampling(self) -> Sampling:
        numbers = self.wavelengths_m, self.weights, self.settings.pixel_scale_mas, np.zeros(2)
        return Sampling(*(torch.as_tensor(n, dtype=torch.float64) for n in numbers))

    def _focal_plane(self, settings: PsfSettings) -> FocalPlane:
        return FocalPlane(settings, self._sampling(), self.pupil_grid, self.polynomials, self.amplitude)

    def _set_products(self, grid: PupilGrid) -> None:
        """Every mode in products of Chebyshev polynomials, and the transforms that serve these products."""
        companions = defocus_series(self.settings.focus_sine) if DEFOCUS in self.nolls else {}
        degree = max((noll_to_nm(noll)[0] for noll in (*self.nolls, *companions)), default=0)
        pairs = products_up_to(degree)
        along_x, along_y = np.array(pairs).T
        reach, middle = grid.u_m[-1] / grid.radius_m, [one / grid.radius_m for one in grid.middle_m]
        terms = in_products(self.nolls, degree, reach, middle)
        if len(companions) > 1:
            shape = in_products([*companions], degree, reach, middle)
            terms[self.nolls.index(DEFOCUS)] = np.tensordot([*companions.values()], shape, 1)
        signs = [-1.0 if a % 2 and b % 2 else 1.0 for a, b in pairs]  # as `MatrixDft.products` returns them
        self.combine = self._real(terms[:, along_y, along_x] * signs)  # (K, pairs)
        self.polynomials = chebyshev.chebvander(grid.u_m / grid.u_m[-1], degree).T

    def _map(self, array) -> torch.Tensor:
        """Real maps of the pupil in the order of `matrix_dft`, (..., n, n)."""
        return mirrored(self._real(array))

    def _real(self, array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=self.dtype, device=self.device)

    def _complex(self, array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=COMPLEX[self.dtype], device=self.device)

    # -- light path --------------------------------------------------------------------------

    def _opd_nm(self, modes_nm: torch.Tensor) -> torch.Tensor:
        """Wavefront with what is known of it, (frames, n, n) in mirrored order [nm]."""
        coefficients = modes_nm.to(self.device, self.dtype)
        return (coefficients @ self.basis).unflatten(1, self.amplitude.shape) + self.known_nm

    def _colour(self, index: int, optics: Optics) -> Colour:
        """The light path at one wavelength, kept for the next call with the same `optics`."""
        kept = self._colours.get((index, id(optics)))
        if kept is None or kept[0] is not optics:
            if len(self._colours) > COLOURS_KEPT:
                self._colours = {}
            self._colours[index, id(optics)] = kept = optics, self._made_colour(index, optics)
        return kept[1]

    def _made_colour(self, index: int, optics: Optics) -> Colour:
        plane, sampling = self.focal_plane, optics.sampling
        wavelength_m = float(self.wavelengths_m[index]) if sampling is None else sampling.wavelengths_m[index]
        transfer = self._transfer(optics.transfer, index)
        matrices = plane.to_pixels(index, sampling, filtered=transfer is not None)
        pupil, grid = self._pupil(optics.pupil, index), plane.grids[index]
        pupil = self.amplitude if pupil is None else pupil
        strained = plane.strained(index, sampling) if sampling is not None and sampling.strains else None
        by_mode = []
        for mode, factors in optics.by_mode:
            in_pupil = self._map(self.pupil_grid.modes([mode.noll])[0].copy())
            in_pupil = in_pupil if mode.of_amplitude else 2 * np.pi * NM / wavelength_m * in_pupil
            by_mode.append(ByMode(in_pupil, mode.of_amplitude, self._factor(factors, index)))
        samples = grid.padded, grid.samples
        return Colour(wavelength_m, pupil, transfer, *matrices, *samples, strained, tuple(by_mode))

    def _pupil(self, pupils: torch.Tensor | None, index: int) -> torch.Tensor | None:
        return None if pupils is None else self._amplitudes(pupils[index])

    def _amplitudes(self, pupils: torch.Tensor) -> torch.Tensor:
        """Complex maps of the pupil, (..., n, n), in the order of `matrix_dft`."""
        return mirrored(self._complex(pupils))

    def _transfer(self, factors: torch.Tensor | None, index: int) -> torch.Tensor | None:
        return None if factors is None else self._factor(factors, index)

    def _factor(self, factors: torch.Tensor, index: int) -> torch.Tensor:
        return (self._complex if factors.is_complex() else self._real)(factors[index])

    def images(self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT) -> torch.Tensor:
        one_path = partial(self._one_path, self._opd_nm(modes_nm))
        return reduce(torch.add, self._along(one_path, self._paths(optics)))

    def _along(self, function: Callable[[_Path], Any], paths: Sequence[_Path]) -> list:
        """What a function makes of all paths; a GPU that one thread asks is not quicker if many do."""
        return ordered_map(function, paths) if self.device == "cpu" else [*map(function, paths)]

    def _paths(self, optics: Optics, tangents: Tangents = NO_TANGENTS, *, rough: bool = False) -> list[_Path]:
        """What light of every wavelength meets, of the star and of its copies; see `rough_derivatives`."""
        own = tangents.copies or [NO_TANGENTS] * len(optics.copies)
        factors = [one.transfer for one in optics.copies]
        follow = [rough and one is not None and float(one.abs().max()) < FAINT for one in factors]
        copies = zip(optics.copies, own, [None] * len(own), follow, strict=True)
        lights = [(optics, tangents, _together(optics, follow), False), *copies]
        return [_Path(*light, index) for light in lights for index in self.colours]

    def _one_path(self, opd: torch.Tensor, path: _Path) -> torch.Tensor:
        colour, dft = self._colour(path.colour, path.optics), self.focal_plane.dfts[path.colour]
        amplitude, *turned = amplitudes_of(colour, dft, colour.field(opd))
        changes = [change_of(amplitude, one) for one in turned]
        return colour.whole_image(intensity_of(amplitude), changes)

    @torch.no_grad()
    def images_and_jacobian(
        self,
        modes_nm: torch.Tensor,
        optics: Optics = AS_BUILT,
        tangents: Tangents = NO_TANGENTS,
        *,
        modal: bool = True,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        per_frame = 2 * self.combine.shape[1] * self.focal_plane.widest.samples**2
        parts = [
            self._chunk(chunk, optics, tangents, modal)
            for chunk in modes_nm.split(max(1, at_once(CHUNK_ELEMENTS, self.device) // per_frame))
        ]
        if len(parts) == 1:
            return parts[0]
        images, jacobians = zip(*parts, strict=True)
        return torch.cat(images), torch.cat(jacobians)

    def _chunk(self, modes_nm, optics: Optics, tangents: Tangents, modal: bool):
        one_path = partial(self._one_path_with_jacobian, self._opd_nm(modes_nm), modal)
        paths = self._paths(optics, tangents, rough=self.rough_derivatives)
        images, jacobians = zip(*self._along(one_path, paths), strict=True)
        return reduce(torch.Tensor.add_, images), reduce(torch.Tensor.add_, jacobians).transpose(0, 1)

    def _one_path_with_jacobian(self, opd, modal: bool, path: _Path):
        """Weighted images, and derivatives (parameters, frames, rows, columns), at one wavelength."""
        tangents, index = path.tangents, path.colour
        colour, dft = self._colour(index, path.optics), self.focal_plane.dfts[index]
        phasor = colour.phasor(opd)
        field = behind(colour.pupil, phasor)
        changing = (
            colour if path.joint is None else colour._replace(transfer=self._transfer(path.joint, index))
        )
        if modal and not path.follows:
            (amplitude, *turned), (changes, *more) = self._amplitudes_and_modal(colour, dft, field)
            columns = [self._derivatives(changing, changes, more)]
        else:
            (amplitude, *turned), columns = amplitudes_of(colour, dft, field), []

        def by_pupil(slopes: Sequence[torch.Tensor]) -> list[torch.Tensor]:
            """Derivatives (slopes, frames, rows, columns), in pieces."""
            pupils = [one[index] for one in slopes]
            many = max(1, at_once(SLOPES_AT_ONCE, self.device) // len(opd))
            pieces = [torch.stack(pupils[i : i + many]) for i in range(0, len(pupils), many)]
            changes = (self._changes(dft, some, phasor) for some in pieces)
            return [self._derivatives(changing, change_of(amplitude, one)) for one in changes]

        intensity = intensity_of(amplitude)
        by_mode = [change_of(amplitude, one) for one in turned]
        if path.follows:
            known = len(tangents.pupil) + (len(self.nolls) if modal else 0)
            columns = [intensity.new_zeros(known, len(opd), *self.settings.window)]
        else:
            columns += by_pupil(tangents.pupil)
        factors = [
            [self._transfer(one, index) for one in parameter]
            for parameter in zip(tangents.transfer, *tangents.by_mode, strict=True)
        ]
        by_transfer = colour.images_through([intensity, *by_mode], factors)
        for place, one in tangents.pupil_too:
            by_transfer[place] = by_transfer[place] + by_pupil([one])[0][0]
        columns += [one[None] for one in by_transfer]
        if tangents.sampling:
            columns.append(self._resampled(colour, opd, path))
        image = colour.whole_image(intensity, by_mode)
        if not columns:
            return image, image.new_empty(0, *image.shape)
        return image, columns[0] if len(columns) == 1 else torch.cat(columns)

    def _resampled(self, colour: Colour, opd: torch.Tensor, path: _Path) -> torch.Tensor:
        """Derivatives of weighted images by the parameters of the sampling; see `resampled`."""
        optics, index = path.optics, path.colour
        sampling = optics.sampling or self.grids.sampling
        every = [
            Rates.of(sampling, change, index, self._pupil(pupil, index), self._transfer(transfer, index))
            for pupil, transfer, change in path.tangents.sampling
        ]
        return resampled(colour, self.focal_plane, index, sampling, opd, every)

    def _changes(self, dft: MatrixDft, pupils: torch.Tensor, phasor) -> torch.Tensor:
        """Focal amplitudes behind several pupils (k, n, n), (k, frames, 2, m, m)."""
        fields = behind(self._amplitudes(pupils)[:, None], phasor)
        return dft.amplitude(fields.flatten(0, 1)).unflatten(0, fields.shape[:2])

    def _derivatives(self, colour: Colour, changes: torch.Tensor, more: Sequence[torch.Tensor] = ()):
        """Weighted pixel flux of the derivatives of the focal intensity, in the precision requested of them.

        Those of its changes by the modes of `Optics.by_mode` are `more`.
        """
        if not self.rough_derivatives or self.dtype == torch.float32:
            return colour.whole_image(changes, more)
        return colour.single.whole_image(changes.float(), [one.float() for one in more]).to(changes)

    @torch.no_grad()
    def images_and_pullback(
        self, modes_nm: torch.Tensor, optics: Optics = AS_BUILT
    ) -> tuple[torch.Tensor, Pullback]:
        """See `LightPath.images_and_pullback`; it costs as little as the images."""
        one_path = partial(self._one_path_with_pullback, self._opd_nm(modes_nm))
        images, to_opd = zip(*self._along(one_path, self._paths(optics)), strict=True)

        def pullback(factors: torch.Tensor) -> torch.Tensor:
            return reduce(torch.add, [back(factors) for back in to_opd]) @ self.basis.mT

        return reduce(torch.add, images), pullback

    def _one_path_with_pullback(self, opd: torch.Tensor, path: _Path):
        """Weighted images at one wavelength, and their pullback to the OPD, (frames, n · n)."""
        colour, dft = self._colour(path.colour, path.optics), self.focal_plane.dfts[path.colour]
        field = colour.field(opd)
        amplitude, *turned = amplitudes_of(colour, dft, field)
        scale = 4 * np.pi * NM / float(colour.wavelength_m)

        def pullback(factors: torch.Tensor) -> torch.Tensor:
            star, *through = (one[:, None] for one in colour.adjoint(factors))
            beats = amplitude * star
            for change, one in zip(turned, through, strict=True):
                beats.addcmul_(change, one)
            back = dft.adjoint(torch.cat([beats, *(amplitude * one for one in through)])).split(len(field))
            return scale * by_phase(colour, field, back).flatten(1)

        changes = [change_of(amplitude, one) for one in turned]
        return colour.whole_image(intensity_of(amplitude), changes), pullback

    def _amplitudes_and_modal(self, colour: Colour, dft: MatrixDft, field: torch.Tensor):
        """Focal amplitudes of `amplitudes_of`, and derivatives (modes, frames, m, m) of what they make.

        These are those of the intensity, and of its changes by the modes of `Optics.by_mode` unless rough
        ones suffice.
        """
        turned_by, own = turned_fields(colour, field), dft.products(field)
        others = [] if self.rough_derivatives else [dft.products(one) for one in turned_by]
        amplitude = own[0][0]  # T_0(x) T_0(y) = 1
        turned = [even[0] for even, _ in others] or amplitudes(dft, turned_by)
        beats = [beat_of(amplitude, own)]
        beats += [beat_of(amplitude, one) + beat_of(by, own) for one, by in zip(others, turned, strict=False)]
        combine = -4 * np.pi * NM / float(colour.wavelength_m) * self.combine
        return [amplitude, *turned], [(combine @ one.flatten(1)).unflatten(1, one.shape[1:]) for one in beats]


def pupil_grid(settings: PsfSettings) -> PupilGrid:
    """Return the samples of the pupil that `settings` ask for."""
    even = settings.pupil_samples + settings.pupil_samples % 2  # `MatrixDft` folds the grid
    return PupilGrid.of(settings.geometry, even, [wavelength * NM for wavelength, _ in settings.spectrum])


class _Path(NamedTuple):
    """Light of the star, or of a copy of it, at the wavelength with the index `colour`."""

    optics: Optics
    tangents: Tangents
    # (wavelengths, p, p//2 + 1), or None: OTF factor of star and faint copies, whose derivatives in the
    # pupil are taken together
    joint: torch.Tensor | None
    follows: bool  # whether this is one of these copies
    colour: int


def _together(optics: Optics, follow: Sequence[bool]) -> torch.Tensor | None:
    """OTF factor of the star and of those copies that follow it; None without any."""
    factors = [one.transfer for one, so in zip(optics.copies, follow, strict=True) if so]
    joint = [one for one in (optics.transfer, *factors) if one is not None]
    return reduce(torch.add, joint) if factors else None
