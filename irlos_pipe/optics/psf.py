"""The forward model: from wavefront coefficients to a pixel-integrated, unit-flux image.

One pass along the light path, shapes ``(frame, wavelength, y, x)``::

    field      E = P exp(2πi Φ/λ)                    pupil: petals, stops, static maps
    amplitude  U = F E Fᵀ                            focal grid, pitch λ/2D'
    intensity  I = |U|² / ∫|P|²                      unit total flux
    OTF        O = FFT(I) · T(λ)                     AO residual, motion, companion, dispersion
    image      Σ_λ w(λ) G(λ) O G(λ)ᵀ                 exactly the detector's pixels: colours, plate scale

What physical effects make of P, T, and of the sampling (λ, w, pixel scale in G) arrives as one
`Optics`. Flux, background and the detector follow in `image_model`. Derivatives are hand-written:
``∂I/∂a_k = -(4π/λ) Im(U* F[Z_k E])``, and because a Zernike polynomial of degree n is a sum of
products T_a(x) T_b(y), a + b ≤ n, the transform along x is shared by all modes. The transforms themselves
are those of `optics.matrix_dft`, where fields are real arrays ``(frame, 2, y, x)``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial, reduce
from itertools import repeat

import numpy as np
import torch
from numpy.polynomial import chebyshev

from irlos_pipe.conventions.units import NM
from irlos_pipe.numerics.parallel import ordered_map
from irlos_pipe.optics.colour import Colour
from irlos_pipe.optics.grids import Grids, Optics, PupilGrid, Sampling, Tangents
from irlos_pipe.optics.matrix_dft import MatrixDft, mirrored, products_up_to
from irlos_pipe.optics.propagate import (
    FocalGrid,
    baseline_to_pixels,
    focal_samples_for,
    focal_to_pixels,
    quick_fft_length,
    require_resolved,
)
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.zernike import noll_to_nm, zernike_basis

COMPLEX = {torch.float32: torch.complex64, torch.float64: torch.complex128}
AS_BUILT, NO_TANGENTS = Optics(), Tangents()
CHUNK_ELEMENTS = 6_000_000  # complex numbers held per batch of frames


class PsfModel:
    """Images of a point source, and their derivatives, for batches of wavefronts.

    Parameters
    ----------
    settings : PsfSettings
    nolls : sequence of int
        Zernike modes that the coefficients refer to.
    device : str
    dtype : torch.float32 or torch.float64
        Of the propagation; sums over pixels are left to the caller, in float64.
    """

    def __init__(
        self,
        settings: PsfSettings,
        nolls: Sequence[int],
        *,
        device: str = "cpu",
        dtype: torch.dtype = torch.float32,
    ):
        self.settings, self.nolls, self.device, self.dtype = settings, tuple(nolls), device, dtype
        wavelengths, weights = np.array(settings.spectrum, float).T
        self.wavelengths_m = wavelengths * NM
        self.weights = weights / weights.sum()
        even = settings.pupil_samples + settings.pupil_samples % 2  # `MatrixDft` folds the grid
        self.pupil_grid = PupilGrid.of(settings.geometry, even, self.wavelengths_m)
        self._set_pupil(self.pupil_grid)
        self._set_products(self.pupil_grid)
        self._set_focal_plane()

    @property
    def grids(self) -> Grids:
        """Where effects can act, for `effects.EffectSet`."""
        numbers = self.wavelengths_m, self.weights, self.settings.pixel_scale_mas
        sampling = Sampling(*(torch.as_tensor(n, dtype=torch.float64) for n in numbers))
        return Grids(self.pupil_grid, self.grid, sampling, self.nolls)

    def in_window(self, window: tuple[int, int], margin_mas: float, halo_margin_mas: float) -> PsfModel:
        """The same light path to another window, see `PsfSettings`."""
        other = copy(self)
        margins = {"margin_mas": margin_mas, "halo_margin_mas": halo_margin_mas}
        other.settings = replace(self.settings, window=window, **margins)
        other._set_focal_plane()
        return other

    @property
    def limits_nm(self) -> torch.Tensor:
        """Least and largest coefficients that the model is good for: there are none, (2, modes)."""
        infinite = torch.full((len(self.nolls),), float("inf"), dtype=torch.float64)
        return torch.stack([-infinite, infinite])

    # -- construction ------------------------------------------------------------------------

    def _focal_grids(self, u: np.ndarray) -> list[FocalGrid]:
        """One grid per wavelength: long waves need fewer samples; the baselines are common."""
        step_m, scale_mas, window_px = u[1] - u[0], self.settings.pixel_scale_mas, max(self.settings.window)
        require_resolved(window_px, scale_mas, self.wavelengths_m.min(), step_m)

        def samples(margin_mas: float, wavelength_m: float) -> int:
            return focal_samples_for(window_px, scale_mas, margin_mas, wavelength_m, len(u) * step_m)

        needed = [samples(self.settings.margin_mas, lam) for lam in self.wavelengths_m]
        period = samples(self.settings.halo_margin_mas, self.wavelengths_m.min())
        padded = quick_fft_length(max(*needed, period))
        return [FocalGrid(count, len(u) * step_m, padded) for count in needed]

    def _set_pupil(self, grid: PupilGrid) -> None:
        self.amplitude = self._map(grid.amplitude)
        self.basis = self._map(grid.modes(self.nolls).copy()).flatten(1)
        known = np.zeros_like(grid.amplitude)
        for noll, nm in self.settings.known.total_nm.items():
            known += nm * grid.modes([noll])[0]
        self.known_nm = self._map(known)

    def _set_products(self, grid: PupilGrid) -> None:
        """Every mode in products of Chebyshev polynomials, and the transforms that serve these products."""
        degree = max((noll_to_nm(noll)[0] for noll in self.nolls), default=0)
        pairs = products_up_to(degree)
        vander = chebyshev.chebvander(grid.u_m / grid.u_m[-1], degree)
        columns = np.stack([np.outer(vander[:, b], vander[:, a])[grid.lit] for a, b in pairs], axis=1)
        modes = zernike_basis(self.nolls, *grid.xy)[:, grid.lit].T
        signs = [-1.0 if a % 2 and b % 2 else 1.0 for a, b in pairs]  # as `MatrixDft.products` returns them
        self.combine = self._real(np.linalg.lstsq(columns, modes, rcond=None)[0].T * signs)  # (K, pairs)
        self.polynomials = vander.T

    def _set_focal_plane(self) -> None:
        u = self.pupil_grid.u_m
        self.focal_grids = self._focal_grids(u)
        self.grid = max(self.focal_grids, key=lambda grid: grid.samples)
        self.dfts = [MatrixDft(u, focal, self.polynomials, self.amplitude) for focal in self.focal_grids]
        for made_when_needed in ("plain", "filtered"):
            self.__dict__.pop(made_when_needed, None)

    @cached_property
    def plain(self) -> list[list[torch.Tensor]]:
        """Pixel matrices of every wavelength for focal intensities."""
        return [self._plain_matrices(*colour) for colour in self._colours()]

    @cached_property
    def filtered(self) -> list[list[torch.Tensor]]:
        """The same for the FFT of focal intensities."""
        return [self._filtered_matrices(*colour) for colour in self._colours()]

    def _colours(self) -> Iterator[tuple]:
        """Pixel scale, wavelength, weight and focal grid of every wavelength."""
        scales = repeat(self.settings.pixel_scale_mas)
        return zip(scales, self.wavelengths_m, self.weights, self.focal_grids, strict=False)

    def _plain_matrices(self, scale_mas, wavelength_m, weight, grid: FocalGrid) -> list[torch.Tensor]:
        """From focal intensity to rows, weighted, and to columns."""
        sides = {*self.settings.window}
        made = {px: focal_to_pixels(px, scale_mas, wavelength_m, grid) for px in sides}
        rows, columns = (made[px] for px in self.settings.window)
        return [self._real(weight * rows), self._real(columns)]

    def _filtered_matrices(self, scale_mas, wavelength_m, weight, grid: FocalGrid) -> list[torch.Tensor]:
        """From the real FFT of the focal intensity to rows, weighted, and to columns."""
        (rows, columns), sky = self.settings.window, (scale_mas, wavelength_m, grid)
        along_y = baseline_to_pixels(grid.baseline_y_m, rows, *sky, half=False)
        along_x = baseline_to_pixels(grid.baseline_x_m, columns, *sky, half=True)
        return [self._complex(weight * along_y), self._complex(along_x)]

    def _map(self, array) -> torch.Tensor:
        """Real maps of the pupil as the propagation wants them, (..., n, n)."""
        return mirrored(self._real(array))

    def _real(self, array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=self.dtype, device=self.device)

    def _complex(self, array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=COMPLEX[self.dtype], device=self.device)

    # -- light path --------------------------------------------------------------------------

    def _opd_nm(self, coefficients_nm: torch.Tensor) -> torch.Tensor:
        """Wavefront with what is known of it, (frames, n, n) in mirrored order [nm]."""
        coefficients = coefficients_nm.to(self.device, self.dtype)
        return (coefficients @ self.basis).unflatten(1, self.amplitude.shape) + self.known_nm

    def _colour(self, index: int, optics: Optics) -> Colour:
        """The light path at one wavelength."""
        wavelength_m = float(self.wavelengths_m[index])
        transfer = None if optics.transfer is None else self._like_images(optics.transfer[index])
        matrices = (self.plain if transfer is None else self.filtered)[index]
        if optics.sampling is not None:
            wavelength_m, weight = optics.sampling.wavelengths_m[index], optics.sampling.weights[index]
            make = self._plain_matrices if transfer is None else self._filtered_matrices
            matrices = make(optics.sampling.pixel_scale_mas, wavelength_m, weight, self.focal_grids[index])
        pupil = self.amplitude if optics.pupil is None else mirrored(self._complex(optics.pupil[index]))
        return Colour(
            wavelength_m, pupil, transfer, *matrices, self.grid.padded, self.focal_grids[index].samples
        )

    def _like_images(self, factor: torch.Tensor) -> torch.Tensor:
        return self._complex(factor) if factor.is_complex() else self._real(factor)

    def images(self, coefficients_nm: torch.Tensor, optics: Optics = AS_BUILT) -> torch.Tensor:
        """Unit-flux images; differentiable by autograd as well.

        Parameters
        ----------
        coefficients_nm : tensor, (frames, modes)
        optics : Optics
            What effects make of the light path, see `effects.EffectSet`.

        Returns
        -------
        tensor, (frames, rows, columns)
        """
        opd = self._opd_nm(coefficients_nm)
        one_colour = partial(self._one_colour, opd, optics)
        return reduce(torch.add, ordered_map(one_colour, range(len(self.weights))))

    def _one_colour(self, opd: torch.Tensor, optics: Optics, index: int) -> torch.Tensor:
        """Weighted images at one wavelength."""
        colour = self._colour(index, optics)
        return colour.image(_intensity(self.dfts[index].amplitude(colour.field(opd))))

    @torch.no_grad()
    def images_and_jacobian(
        self,
        coefficients_nm: torch.Tensor,
        optics: Optics = AS_BUILT,
        tangents: Tangents = NO_TANGENTS,
        *,
        modal: bool = True,
    ):
        """Images and their derivatives.

        Parameters
        ----------
        coefficients_nm : tensor, (frames, modes)
        optics : see `images`
        tangents : Tangents
            Derivatives of pupil and OTF factors with respect to effect parameters.
        modal : bool
            False leaves the derivatives with respect to the modes out.

        Returns
        -------
        images : tensor, (frames, rows, columns)
        jacobian : tensor, (frames, modes + parameters, rows, columns)
            First the modes [1/nm], then the parameters in the pupil, then those of the OTF.
        """
        per_frame = 2 * self.combine.shape[1] * self.grid.samples**2
        parts = [
            self._chunk(chunk, optics, tangents, modal)
            for chunk in coefficients_nm.split(max(1, CHUNK_ELEMENTS // per_frame))
        ]
        return parts[0] if len(parts) == 1 else tuple(map(torch.cat, zip(*parts, strict=True)))

    def _chunk(self, coefficients_nm, optics: Optics, tangents: Tangents, modal: bool):
        opd = self._opd_nm(coefficients_nm)
        one_colour = partial(self._one_colour_with_jacobian, opd, optics, tangents, modal)
        images, jacobians = zip(*ordered_map(one_colour, range(len(self.weights))), strict=True)
        return reduce(torch.Tensor.add_, images), reduce(torch.Tensor.add_, jacobians).transpose(0, 1)

    def _one_colour_with_jacobian(self, opd, optics: Optics, tangents: Tangents, modal: bool, index: int):
        """Weighted images, and derivatives (parameters, frames, rows, columns), at one wavelength."""
        colour, dft = self._colour(index, optics), self.dfts[index]
        field = colour.field(opd)
        if modal:
            amplitude, changes = self._amplitude_and_modal(dft, field, float(colour.wavelength_m))
            columns = [colour.image(changes)]
        else:
            amplitude, columns = dft.amplitude(field), []
        for one in tangents.pupil:
            change = dft.amplitude(colour.field(opd, mirrored(self._complex(one[index]))))
            columns.append(colour.image(2 * (amplitude * change).sum(1))[None])
        intensity = _intensity(amplitude)
        columns += [colour.image(intensity, self._like_images(one[index]))[None] for one in tangents.transfer]
        return colour.image(intensity), columns[0] if len(columns) == 1 else torch.cat(columns)

    @torch.no_grad()
    def images_and_pullback(self, coefficients_nm: torch.Tensor, optics: Optics = AS_BUILT):
        """Images and the transpose of their Jacobian, which costs as little as the images.

        Returns
        -------
        images : tensor, (frames, rows, columns)
        pullback : callable
            From factors of all pixels, (frames, rows, columns), to the derivatives of the images' sum
            with these factors, (frames, modes) [1/nm].
        """
        opd = self._opd_nm(coefficients_nm)
        one_colour = partial(self._one_colour_with_pullback, opd, optics)
        images, to_opd = zip(*ordered_map(one_colour, range(len(self.weights))), strict=True)

        def pullback(factors: torch.Tensor) -> torch.Tensor:
            return reduce(torch.add, [back(factors) for back in to_opd]) @ self.basis.mT

        return reduce(torch.add, images), pullback

    def _one_colour_with_pullback(self, opd: torch.Tensor, optics: Optics, index: int):
        """Weighted images at one wavelength, and their pullback to the OPD, (frames, n · n)."""
        colour, dft = self._colour(index, optics), self.dfts[index]
        field = colour.field(opd)
        amplitude = dft.amplitude(field)
        scale = 4 * np.pi * NM / float(colour.wavelength_m)

        def pullback(factors: torch.Tensor) -> torch.Tensor:
            change = dft.adjoint(amplitude * (scale * colour.adjoint(factors))[:, None])
            return (field[:, 0] * change[:, 1] - field[:, 1] * change[:, 0]).flatten(1)

        return colour.image(_intensity(amplitude)), pullback

    def _amplitude_and_modal(self, dft: MatrixDft, field: torch.Tensor, wavelength_m: float):
        """Focal amplitude (frames, 2, m, m) and intensity derivatives (modes, frames, m, m)."""
        even, odd = dft.products(field)
        amplitude = even[0]  # T_0(x) T_0(y) = 1
        real, imag = amplitude[:, 0], amplitude[:, 1]
        beat = torch.cat([even[:, :, 1], odd[:, :, 0]]) * real
        beat[: len(even)].addcmul_(even[:, :, 0], imag, value=-1)
        beat[len(even) :].addcmul_(odd[:, :, 1], imag)
        scale = -4 * np.pi * NM / wavelength_m
        return amplitude, ((scale * self.combine) @ beat.flatten(1)).unflatten(1, beat.shape[1:])


def _intensity(amplitude: torch.Tensor) -> torch.Tensor:
    """``|U|²``, (frames, m, m)."""
    return amplitude.square().sum(1)
