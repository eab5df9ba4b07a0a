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
products T_a(x) T_b(y), a + b ≤ n, the transform along x is shared by all modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.polynomial import chebyshev

from .geometry import PupilGeometry
from .optics.colour import Colour
from .optics.grids import NM, Optics, PupilGrid, Sampling, Stations, Tangents
from .optics.propagate import (
    FocalGrid,
    baseline_to_pixels,
    focal_samples_for,
    focal_to_pixels,
    pupil_to_focal,
    require_resolved,
)
from .optics.zernike import noll_to_nm, zernike_basis
from .parallel import ordered_map

COMPLEX = {torch.float32: torch.complex64, torch.float64: torch.complex128}
AS_BUILT, NO_TANGENTS = Optics(), Tangents()
CHUNK_ELEMENTS = 6_000_000  # complex numbers held per batch of frames


@dataclass(frozen=True)
class PsfSettings:
    """Everything about the instrument and its sampling that a `PsfModel` needs.

    Attributes
    ----------
    geometry : PupilGeometry
    window : (int, int)
        Rows and columns of the detector window [px].
    pixel_scale_mas : float
    spectrum : sequence of (wavelength_nm, weight)
        Photon weights, any positive scale.
    diversity : dict of int to float
        Noll index to nm RMS, always present in the light path.
    pupil_samples : int
        Samples across the pupil diameter; 128 keeps the error below 1e-4 of the peak for
        wavefronts up to 600 nm RMS (tests/test_psf_accuracy.py).
    margin_mas : float
        Field computed beyond the window on each side. The end of the field rings into the
        window when the intensity is interpolated to the pixels: with 100 mas by 1e-5 of a compact
        peak and 2e-4 of one spread to the window's edge, with 200 mas by 2e-6 and 5e-5.
    halo_margin_mas : float
        The same for the period of the OTF factors, whose wings are wider.
    """

    geometry: PupilGeometry
    window: tuple[int, int]
    pixel_scale_mas: float
    spectrum: tuple[tuple[float, float], ...]
    diversity: dict[int, float]
    pupil_samples: int = 128
    margin_mas: float = 200.0
    halo_margin_mas: float = 500.0


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
        self.pupil_grid = PupilGrid.of(settings.geometry, settings.pupil_samples, self.wavelengths_m)
        self.grids = self._focal_grids(self.pupil_grid.u_m)
        self.grid = max(self.grids, key=lambda grid: grid.samples)
        self._set_pupil(self.pupil_grid)
        self._set_products(self.pupil_grid)
        self._set_pixels()

    @property
    def stations(self) -> Stations:
        """Where effects can act, for `effects.EffectSet`."""
        numbers = self.wavelengths_m, self.weights, self.settings.pixel_scale_mas
        sampling = Sampling(*(torch.as_tensor(n, dtype=torch.float64) for n in numbers))
        return Stations(self.pupil_grid, self.grid, sampling, self.nolls)

    # -- construction ------------------------------------------------------------------------

    def _focal_grids(self, u: np.ndarray) -> list[FocalGrid]:
        """One grid per wavelength: long waves need fewer samples; the baselines are common."""
        step_m, scale_mas, window_px = u[1] - u[0], self.settings.pixel_scale_mas, max(self.settings.window)
        require_resolved(window_px, scale_mas, self.wavelengths_m.min(), step_m)

        def samples(margin_mas: float, wavelength_m: float) -> int:
            return focal_samples_for(window_px, scale_mas, margin_mas, wavelength_m, len(u) * step_m)

        needed = [samples(self.settings.margin_mas, lam) for lam in self.wavelengths_m]
        padded = max(*needed, samples(self.settings.halo_margin_mas, self.wavelengths_m.min()))
        return [FocalGrid(count, len(u) * step_m, padded) for count in needed]

    def _set_pupil(self, grid: PupilGrid) -> None:
        self.amplitude = self._real(grid.amplitude)
        self.basis = self._real(grid.modes(self.nolls).copy()).reshape(len(self.nolls), -1)
        diversity = np.zeros_like(grid.amplitude)
        for noll, value_nm in self.settings.diversity.items():
            diversity += value_nm * grid.modes([noll])[0]
        self.diversity_nm = self._real(diversity)
        self.to_focal = [self._complex(pupil_to_focal(grid.u_m, focal)) for focal in self.grids]

    def _set_products(self, grid: PupilGrid) -> None:
        """Every mode in products of Chebyshev polynomials, and the transforms of these along one axis."""
        self.degree = max((noll_to_nm(noll)[0] for noll in self.nolls), default=0)
        self.pairs = [(a, b) for b in range(self.degree + 1) for a in range(self.degree + 1 - b)]
        vander = chebyshev.chebvander(grid.u_m / grid.u_m[-1], self.degree)
        columns = np.stack([np.outer(vander[:, b], vander[:, a])[grid.lit] for a, b in self.pairs], axis=1)
        modes = zernike_basis(self.nolls, *grid.xy)[:, grid.lit].T
        self.combine = self._real(np.linalg.lstsq(columns, modes, rcond=None)[0].T)  # (K, pairs)
        polynomials = self._complex(vander.T)
        self.weighted_to_focal = [  # (degree+1, m, n) each
            polynomials[:, None, :] * matrix[None] for matrix in self.to_focal
        ]

    def _set_pixels(self) -> None:
        colours = list(zip(self.wavelengths_m, self.grids, strict=True))
        scale = self.settings.pixel_scale_mas
        self.plain = [self._plain_matrices(scale, *colour) for colour in colours]
        self.filtered = [self._filtered_matrices(scale, *colour) for colour in colours]

    def _plain_matrices(self, scale_mas, wavelength_m, grid: FocalGrid) -> list[torch.Tensor]:
        """From focal intensity to rows and to columns."""
        return [self._real(focal_to_pixels(px, scale_mas, wavelength_m, grid)) for px in self.settings.window]

    def _filtered_matrices(self, scale_mas, wavelength_m, grid: FocalGrid) -> list[torch.Tensor]:
        """From the real FFT of the focal intensity to rows and to columns."""
        (rows, columns), sky = self.settings.window, (scale_mas, wavelength_m, grid)
        along_y = baseline_to_pixels(grid.baseline_y_m, rows, *sky, half=False)
        along_x = baseline_to_pixels(grid.baseline_x_m, columns, *sky, half=True)
        return [self._complex(along_y), self._complex(along_x)]

    def _real(self, array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=self.dtype, device=self.device)

    def _complex(self, array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=COMPLEX[self.dtype], device=self.device)

    # -- light path --------------------------------------------------------------------------

    def opd_nm(self, coefficients_nm: torch.Tensor) -> torch.Tensor:
        """Wavefront with the diversity, (frames, n, n), from coefficients (frames, modes) [nm]."""
        coefficients = coefficients_nm.to(self.device, self.dtype)
        return (coefficients @ self.basis).reshape(-1, *self.amplitude.shape) + self.diversity_nm

    def _colour(self, index: int, optics: Optics) -> Colour:
        """The light path at one wavelength."""
        wavelength_m, weight = float(self.wavelengths_m[index]), float(self.weights[index])
        transfer = None if optics.transfer is None else self._like_images(optics.transfer[index])
        matrices = (self.plain if transfer is None else self.filtered)[index]
        if optics.sampling is not None:
            wavelength_m, weight = optics.sampling.wavelengths_m[index], optics.sampling.weights[index]
            make = self._plain_matrices if transfer is None else self._filtered_matrices
            matrices = make(optics.sampling.pixel_scale_mas, wavelength_m, self.grids[index])
        pupil = self.amplitude if optics.pupil is None else self._complex(optics.pupil[index])
        return Colour(wavelength_m, weight, pupil, transfer, *matrices, self.grid.padded)

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
        opd = self.opd_nm(coefficients_nm)
        return sum(ordered_map(lambda index: self._one_colour(opd, index, optics), range(len(self.weights))))

    def _one_colour(self, opd: torch.Tensor, index: int, optics: Optics) -> torch.Tensor:
        """Weighted images at one wavelength."""
        colour = self._colour(index, optics)
        amplitude = self._amplitude(colour, opd, index)
        return colour.weight * colour.image(amplitude.real**2 + amplitude.imag**2)

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
        per_frame = len(self.pairs) * self.grid.samples**2
        parts = [
            self._chunk(chunk, optics, tangents, modal)
            for chunk in coefficients_nm.split(max(1, CHUNK_ELEMENTS // per_frame))
        ]
        return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])

    def _chunk(self, coefficients_nm, optics: Optics, tangents: Tangents, modal: bool):
        opd = self.opd_nm(coefficients_nm)
        colours = ordered_map(
            lambda index: self._one_colour_with_jacobian(opd, index, optics, tangents, modal),
            range(len(self.weights)),
        )
        return sum(colour[0] for colour in colours), sum(colour[1] for colour in colours)

    def _one_colour_with_jacobian(self, opd, index: int, optics: Optics, tangents: Tangents, modal: bool):
        """Weighted images and derivatives at one wavelength."""
        colour = self._colour(index, optics)
        if modal:
            amplitude, changes = self._amplitude_and_modal(colour, opd, index)
            columns = [colour.image(changes)]
        else:
            amplitude, columns = self._amplitude(colour, opd, index), []
        intensity = amplitude.real**2 + amplitude.imag**2
        columns += [
            colour.image(self._beat(amplitude, colour, opd, self._complex(one[index]), index))[:, None]
            for one in tangents.pupil
        ]
        columns += [
            colour.image(intensity, self._like_images(one[index]))[:, None] for one in tangents.transfer
        ]
        return colour.weight * colour.image(intensity), colour.weight * torch.cat(columns, dim=1)

    def _beat(self, amplitude, colour: Colour, opd, change, index: int) -> torch.Tensor:
        """Derivative of the intensity, (frames, m, m), for a `change` (n, n) of the pupil's amplitude."""
        to_focal = self.to_focal[index]
        return 2 * (amplitude.conj() * (to_focal @ (change * colour.phasor(opd)) @ to_focal.mT)).real

    def _amplitude(self, colour: Colour, opd: torch.Tensor, index: int) -> torch.Tensor:
        """Focal amplitude, (frames, m, m)."""
        to_focal = self.to_focal[index]
        return to_focal @ colour.field(opd) @ to_focal.mT

    def _amplitude_and_modal(self, colour: Colour, opd: torch.Tensor, index: int):
        """Focal amplitude (frames, m, m) and intensity derivatives (frames, modes, m, m)."""
        to_focal, m = self.weighted_to_focal[index], self.grids[index].samples
        field = colour.field(opd)
        along_x = field @ to_focal.reshape(-1, field.shape[-1]).mT  # (frames, n, (degree+1)·m)
        along_x = along_x.reshape(*field.shape[:2], self.degree + 1, m).transpose(1, 2).contiguous()
        along_y = [to_focal[b] @ along_x[:, : self.degree + 1 - b] for b in range(self.degree + 1)]
        products = torch.cat(along_y, dim=1)  # (frames, pairs, m, m)
        amplitude = products[:, 0]  # T_0(x) T_0(y) = 1
        beat = (products * amplitude.conj()[:, None]).imag
        scale = float(-4 * np.pi * NM / colour.wavelength_m)
        changes = (scale * self.combine) @ beat.reshape(*beat.shape[:2], -1)
        return amplitude, changes.reshape(len(opd), -1, m, m)
