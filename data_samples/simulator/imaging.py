"""From the OPD in the pupil to the mean number of photons in each pixel."""

from __future__ import annotations

import numpy as np
from hcipy import CartesianGrid, Field, MatrixFourierTransform, SeparatedCoords

from simulator.telescope import Telescope

MAS = np.deg2rad(1 / 3.6e6)
PIXEL_NODES = 3


class Imager:
    """Images of a point source through the telescope in a given spectrum.

    `photons` are the weights of the wavelengths, normalised here to a sum of one. The window is square;
    the optical axis lies at (window_px - 1) / 2.
    """

    def __init__(self, telescope: Telescope, wavelengths_nm, photons, window_px: int, pixel_scale_mas: float):
        self.window_px = window_px
        self.wavelengths_nm = np.asarray(wavelengths_nm, dtype=float)
        self.weights = np.asarray(photons, dtype=float) / np.sum(photons)
        self.amplitude = telescope.transmission.astype(np.float32)
        # Each pixel is integrated by a Gauss-Legendre rule per axis. The image holds no frequency above
        # D/lambda, for which three points are exact to 1e-4 at 9.7 mas in J and H.
        nodes, weights = np.polynomial.legendre.leggauss(PIXEL_NODES)
        centres = np.arange(window_px) - (window_px - 1) / 2
        position_px, self._node_weights = (centres[:, None] + nodes / 2).ravel(), weights / 2
        self._transforms = [
            _transform(telescope, position_px * pixel_scale_mas * MAS, wavelength_nm)
            for wavelength_nm in self.wavelengths_nm
        ]
        pixel_rad2 = (pixel_scale_mas * MAS) ** 2
        # Parseval: the integral of |FT|^2 over angle is lambda^2 times the energy in the pupil, which is its
        # area; the sum of the squared grey transmission would miss a part of the light at the edges.
        area_m2 = telescope.transmission.sum() * telescope.step_m**2
        self._scales = [pixel_rad2 / (area_m2 * (nm * 1e-9) ** 2) for nm in self.wavelengths_nm]

    def image(self, opd_nm: np.ndarray) -> np.ndarray:
        """Return the fraction of the photons in each pixel, (window_px, window_px) float64.

        PSF(a) = |integral P exp(2 pi i OPD / lambda) exp(-2 pi i a u / lambda) du|^2, the sign of HCIPy's
        forward transform; a positive x-tilt moves the image to larger columns.
        """
        nodes = sum(
            weight * scale * self._intensity(transform, opd_nm, wavelength_nm)
            for transform, wavelength_nm, weight, scale in zip(
                self._transforms, self.wavelengths_nm, self.weights, self._scales, strict=True
            )
        )
        shape = (self.window_px, PIXEL_NODES, self.window_px, PIXEL_NODES)
        return np.einsum("yjxi,j,i->yx", nodes.reshape(shape), self._node_weights, self._node_weights)

    def _intensity(self, transform, opd_nm: np.ndarray, wavelength_nm: float) -> np.ndarray:
        phase = np.asarray(opd_nm, dtype=np.float32) * np.float32(2 * np.pi / wavelength_nm)
        field = np.empty(phase.shape, np.complex64)
        field.real = self.amplitude * np.cos(phase)
        field.imag = self.amplitude * np.sin(phase)
        focal = transform.forward(Field(field.ravel(), transform.input_grid))
        return np.asarray(focal.real**2 + focal.imag**2, dtype=float)


def _transform(telescope: Telescope, angle_rad: np.ndarray, wavelength_nm: float) -> MatrixFourierTransform:
    frequency = 2 * np.pi * angle_rad / (wavelength_nm * 1e-9)
    focal_grid = CartesianGrid(SeparatedCoords([frequency, frequency]))
    return MatrixFourierTransform(
        telescope.grid, focal_grid, precompute_matrices=True, allocate_intermediate=True
    )
