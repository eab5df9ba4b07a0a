"""The forward model: from wavefront coefficients to a pixel-integrated, unit-flux image.

One pass along the light path, shapes ``(frame, wavelength, y, x)``::

    field      E = P exp(2πi Φ/λ)                    pupil
    amplitude  U = F E Fᵀ                            focal grid, pitch λ/2D'
    intensity  I = |U|² / ∫|P|²                      unit total flux
    OTF        O = FFT(I) · T(λ)                     AO residual, jitter, object
    image      Σ_λ w(λ) G(λ) O G(λ)ᵀ                 exactly the detector's pixels

Flux and background multiply and add outside: they are parameters of a fit, not of the
optics. Derivatives are hand-written. ``∂I/∂a_k = -(4π/λ) Im(U* F[Z_k E])``, and because a
Zernike polynomial of degree n is a sum of products T_a(x) T_b(y), a + b ≤ n, the transform
along x is shared by all modes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.polynomial import chebyshev

from .geometry import PupilGeometry
from .optics.propagate import (
    FocalGrid,
    baseline_to_pixels,
    focal_samples_for,
    focal_to_pixels,
    pupil_to_focal,
    require_resolved,
)
from .optics.pupil import band_limited_pupil
from .optics.zernike import noll_to_nm, zernike_basis
from .parallel import ordered_map

NM = 1e-9
COMPLEX = {torch.float32: torch.complex64, torch.float64: torch.complex128}
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
        u, amplitude = band_limited_pupil(settings.geometry, settings.pupil_samples)
        self.grids = self._focal_grids(u)
        self.grid = max(self.grids, key=lambda grid: grid.samples)
        self._set_pupil(u, amplitude)
        self._set_pixels()

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

    def _set_pupil(self, u: np.ndarray, amplitude: np.ndarray) -> None:
        radius = self.settings.geometry.diameter_m / 2
        x, y = np.meshgrid(u / radius, u / radius)
        lit = np.hypot(x, y) <= 1 + 12 / self.settings.pupil_samples  # no huge continuations in dark corners
        step = u[1] - u[0]
        # The pupil is clear or opaque, so ∫P² = ∫P, and the mean survives the band limit.
        norm = np.sqrt(np.sum(amplitude)) * step * (2 * self.grid.width_m)
        self.amplitude = self._real(np.where(lit, amplitude, 0) / norm)
        self.basis = self._real(zernike_basis(self.nolls, x, y) * lit).reshape(len(self.nolls), -1)
        diversity = np.zeros_like(x)
        for noll, value_nm in self.settings.diversity.items():
            diversity += value_nm * zernike_basis([noll], x, y)[0]
        self.diversity_nm = self._real(diversity * lit)
        self._set_products(u / u[-1], x * lit, y * lit, lit)
        self.to_focal = [self._complex(pupil_to_focal(u, grid)) for grid in self.grids]
        polynomials = self._complex(chebyshev.chebvander(u / u[-1], self.degree).T)
        self.weighted_to_focal = [  # (degree+1, m, n) each
            polynomials[:, None, :] * matrix[None] for matrix in self.to_focal
        ]

    def _set_products(self, t: np.ndarray, x: np.ndarray, y: np.ndarray, lit: np.ndarray) -> None:
        """Coefficients of every mode in products of Chebyshev polynomials."""
        self.degree = max((noll_to_nm(noll)[0] for noll in self.nolls), default=0)
        self.pairs = [(a, b) for b in range(self.degree + 1) for a in range(self.degree + 1 - b)]
        vander = chebyshev.chebvander(t, self.degree)
        columns = np.stack([np.outer(vander[:, b], vander[:, a])[lit] for a, b in self.pairs], axis=1)
        modes = zernike_basis(self.nolls, x, y)[:, lit].T
        self.combine = self._real(np.linalg.lstsq(columns, modes, rcond=None)[0].T)  # (K, pairs)

    def _set_pixels(self) -> None:
        rows, columns = self.settings.window
        scale = self.settings.pixel_scale_mas
        self.plain, self.filtered = [], []
        for lam, grid in zip(self.wavelengths_m, self.grids, strict=True):
            self.plain.append([self._real(focal_to_pixels(px, scale, lam, grid)) for px in (rows, columns)])
            along_y = baseline_to_pixels(grid.baseline_y_m, rows, scale, lam, grid, half=False)
            along_x = baseline_to_pixels(grid.baseline_x_m, columns, scale, lam, grid, half=True)
            self.filtered.append([self._complex(along_y), self._complex(along_x)])

    def _real(self, array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=self.dtype, device=self.device)

    def _complex(self, array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=COMPLEX[self.dtype], device=self.device)

    # -- light path --------------------------------------------------------------------------

    def opd_nm(self, coefficients_nm: torch.Tensor) -> torch.Tensor:
        """Wavefront with the diversity, (frames, n, n), from coefficients (frames, modes) [nm]."""
        coefficients = coefficients_nm.to(self.device, self.dtype)
        return (coefficients @ self.basis).reshape(-1, *self.amplitude.shape) + self.diversity_nm

    def field(self, opd_nm: torch.Tensor, wavelength_m: float) -> torch.Tensor:
        """Complex field in the pupil."""
        return torch.polar(self.amplitude.expand_as(opd_nm), opd_nm * (2 * np.pi * NM / wavelength_m))

    def to_image(
        self, intensity: torch.Tensor, wavelength: int, transfer: torch.Tensor | None
    ) -> torch.Tensor:
        """Pixel flux from focal intensity ``(..., m, m)`` at one wavelength, through the OTF factors."""
        if transfer is None:
            to_rows, to_columns = self.plain[wavelength]
            return to_rows @ intensity @ to_columns.mT
        to_rows, to_columns = self.filtered[wavelength]
        spectrum = torch.fft.rfft2(intensity, s=(self.grid.padded,) * 2) * transfer[wavelength]
        partial = to_rows @ spectrum
        return partial.real @ to_columns.real.mT - partial.imag @ to_columns.imag.mT

    def images(self, coefficients_nm: torch.Tensor, transfer: torch.Tensor | None = None) -> torch.Tensor:
        """Unit-flux images; differentiable by autograd as well.

        Parameters
        ----------
        coefficients_nm : tensor, (frames, modes)
        transfer : tensor, (wavelengths, p, p//2 + 1), optional
            OTF factors on the baselines of `grid`, p = ``grid.padded``.

        Returns
        -------
        tensor, (frames, rows, columns)
        """
        opd = self.opd_nm(coefficients_nm)
        return sum(
            ordered_map(lambda index: self._one_colour(opd, index, transfer), range(len(self.weights)))
        )

    def _one_colour(self, opd: torch.Tensor, index: int, transfer: torch.Tensor | None) -> torch.Tensor:
        """Weighted images at one wavelength."""
        to_focal = self.to_focal[index]
        amplitude = to_focal @ self.field(opd, self.wavelengths_m[index]) @ to_focal.mT
        intensity = amplitude.real**2 + amplitude.imag**2
        return float(self.weights[index]) * self.to_image(intensity, index, transfer)

    @torch.no_grad()
    def images_and_jacobian(
        self,
        coefficients_nm: torch.Tensor,
        transfer: torch.Tensor | None = None,
        transfer_derivatives: torch.Tensor | None = None,
    ):
        """Images and their derivatives.

        Parameters
        ----------
        coefficients_nm : tensor, (frames, modes)
        transfer : see `images`
        transfer_derivatives : tensor, (parameters, wavelengths, m, m//2 + 1), optional

        Returns
        -------
        images : tensor, (frames, rows, columns)
        jacobian : tensor, (frames, modes + parameters, rows, columns)
            First the modes [1/nm], then the OTF parameters.
        """
        per_frame = len(self.pairs) * self.grid.samples**2
        parts = [
            self._chunk(chunk, transfer, transfer_derivatives)
            for chunk in coefficients_nm.split(max(1, CHUNK_ELEMENTS // per_frame))
        ]
        return torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])

    def _chunk(self, coefficients_nm, transfer, transfer_derivatives):
        opd = self.opd_nm(coefficients_nm)
        colours = ordered_map(
            lambda index: self._one_colour_with_jacobian(opd, index, transfer, transfer_derivatives),
            range(len(self.weights)),
        )
        return sum(colour[0] for colour in colours), sum(colour[1] for colour in colours)

    def _one_colour_with_jacobian(self, opd, index, transfer, transfer_derivatives):
        """Weighted images and derivatives at one wavelength."""
        amplitude, modal = self._amplitude_and_modal(opd, index)
        intensity = amplitude.real**2 + amplitude.imag**2
        columns = [self.to_image(modal, index, transfer)]
        if transfer_derivatives is not None:
            columns += [self.to_image(intensity, index, one)[:, None] for one in transfer_derivatives]
        weight = float(self.weights[index])
        return weight * self.to_image(intensity, index, transfer), weight * torch.cat(columns, dim=1)

    def _amplitude_and_modal(self, opd: torch.Tensor, index: int):
        """Focal amplitude (frames, m, m) and intensity derivatives (frames, modes, m, m)."""
        wavelength_m, m = self.wavelengths_m[index], self.grids[index].samples
        to_focal = self.weighted_to_focal[index]
        field = self.field(opd, wavelength_m)
        along_x = field @ to_focal.reshape(-1, field.shape[-1]).mT  # (frames, n, (degree+1)·m)
        along_x = along_x.reshape(*field.shape[:2], self.degree + 1, m).transpose(1, 2).contiguous()
        along_y = [to_focal[b] @ along_x[:, : self.degree + 1 - b] for b in range(self.degree + 1)]
        products = torch.cat(along_y, dim=1)  # (frames, pairs, m, m)
        amplitude = products[:, 0]  # T_0(x) T_0(y) = 1
        beat = (products * amplitude.conj()[:, None]).imag
        scale = -4 * np.pi * NM / wavelength_m
        modal = (scale * self.combine) @ beat.reshape(*beat.shape[:2], -1)
        return amplitude, modal.reshape(len(opd), -1, m, m)
