"""LIFT frame by frame with NumPy's FFT, as the paper's code does it: Gauss–Newton, one FFT per derivative.

Every wavelength has its own padding, such that the FFT's pitch is the detector's; pixels are samples, not
areas. Modes, flux and background are fitted, each pixel weighted with the variance its own value implies.
"""

from __future__ import annotations

import numpy as np

from irlos_pipe.optics.fourier_matrices import MAS
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.pupil import area_weighted_pupil, grid_centres
from irlos_pipe.optics.zernike import zernike_basis

PUPIL_SAMPLES = 127
MAX_ITERATIONS, RELATIVE_FALL = 20, 1e-4  # stop when χ² falls by less than this part
NM = 1e-9


class NumpyLift:
    """Fits one frame after the other; pupil and modes are computed once.

    The `settings` have spectrum, plate scale, square window and known wavefront.
    """

    def __init__(self, settings: PsfSettings, nolls, read_noise_e: float):
        self.step_m = settings.geometry.diameter_m / PUPIL_SAMPLES
        self.scale_rad = settings.pixel_scale_mas * MAS
        self.window_px = settings.window[0]
        u = grid_centres(PUPIL_SAMPLES, self.step_m)
        self.x_m, self.y_m = np.meshgrid(u, u)
        unit = self.x_m / (settings.geometry.diameter_m / 2), self.y_m / (settings.geometry.diameter_m / 2)
        self.amplitude = area_weighted_pupil(settings.geometry, u)
        self.basis = zernike_basis(nolls, *unit)
        self.fixed_nm = sum(
            nm * zernike_basis([noll], *unit)[0] for noll, nm in settings.known.total_nm.items()
        )
        light = sum(weight for _, weight in settings.spectrum)
        self.spectrum = [(nm * NM, weight / light) for nm, weight in settings.spectrum]
        self.read_noise_e = read_noise_e

    def images(self, coefficients_nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit-flux image (window, window) and its derivatives (modes, window, window) [1/nm]."""
        opd_nm = np.tensordot(coefficients_nm, self.basis, 1) + self.fixed_nm
        parts = [self._one_colour(opd_nm, *colour) for colour in self.spectrum]
        return sum(image for image, _ in parts), sum(slopes for _, slopes in parts)

    def _one_colour(self, opd_nm: np.ndarray, wavelength_m: float, weight: float):
        padded = round(wavelength_m / (self.step_m * self.scale_rad))
        per_nm = 2 * np.pi * NM / wavelength_m
        # Half a pixel of tilt brings the zero frequency between the central four pixels.
        half_pixel = 0 if self.window_px % 2 else np.pi / (padded * self.step_m) * (self.x_m + self.y_m)
        field = self.amplitude * np.exp(1j * (per_nm * opd_nm - half_pixel))
        amplitude = self._transformed(field, padded)
        norm = weight / (self.amplitude.sum() * padded**2)
        changes = [self._transformed(1j * per_nm * mode * field, padded) for mode in self.basis]
        slopes = [2 * norm * (amplitude.conj() * change).real for change in changes]
        return norm * np.abs(amplitude) ** 2, np.array(slopes)

    def _transformed(self, field: np.ndarray, padded: int) -> np.ndarray:
        middle, half = padded // 2, self.window_px // 2
        cut = slice(middle - half, middle - half + self.window_px)
        return np.fft.fftshift(np.fft.fft2(field, s=(padded, padded)))[cut, cut]

    def fit_nm(self, image_e: np.ndarray) -> np.ndarray:
        """Coefficients of one frame [nm RMS], started from zero."""
        root = 1 / np.sqrt(np.maximum(image_e, 0) + self.read_noise_e**2)
        x = np.zeros(len(self.basis) + 2)
        x[-2], before = image_e.sum(), np.inf
        for _ in range(MAX_ITERATIONS):
            unit, slopes = self.images(x[:-2])
            columns = np.stack([*(x[-2] * slopes), unit, np.ones_like(unit)])
            residual = (image_e - x[-2] * unit - x[-1]) * root
            chi2 = float((residual**2).sum())
            if chi2 > before * (1 - RELATIVE_FALL):
                break
            before = chi2
            x = x + np.linalg.lstsq((columns * root).reshape(len(x), -1).T, residual.ravel(), rcond=None)[0]
        return x[:-2]
