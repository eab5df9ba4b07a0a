"""From the wavefront in the pupil to the light in each pixel: a matrix DFT onto points inside the pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.units import MAS, NM
from irlos_pipe.simulate.aperture import centres
from irlos_pipe.simulate.light import Ray

BATCH = 10  # wavefronts imaged together


@dataclass(frozen=True)
class PixelGrid:
    """Pixels about the optical axis, which lies at (N - 1) / 2 of rows and columns.

    Attributes
    ----------
    window : (int, int)
        Rows and columns [px].
    scale_mas : float
        Edge of a pixel.
    nodes : int
        Of the Gauss–Legendre rule that integrates a pixel, per axis. The image holds no frequency
        above D/λ, a third of a cycle per pixel of 9.7 mas, for which four nodes err by 1e-7; one is the
        value at the centre.
    """

    window: tuple[int, int]
    scale_mas: float
    nodes: int = 4

    def node_angles_mas(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions of all nodes along y, (rows * nodes,), and along x, (columns * nodes,) [mas]."""
        inner = np.polynomial.legendre.leggauss(self.nodes)[0] / 2
        y, x = ((centres(size, 1.0)[:, None] + inner).ravel() * self.scale_mas for size in self.window)
        return y, x

    def integrated(self, intensity: np.ndarray) -> np.ndarray:
        """Integral over every pixel [mas²] of the intensity at its nodes, (times, rows, columns) float64."""
        weights = np.polynomial.legendre.leggauss(self.nodes)[1] / 2 * self.scale_mas
        (rows, columns), k = self.window, self.nodes
        return np.einsum("tyjxi,j,i->tyx", intensity.reshape(-1, rows, k, columns, k), weights, weights)


class Imager:
    """Pixel-integrated images.

    ``PSF(a) = |∫ P(u) exp(2πi Φ(u)/λ) exp(-2πi a·u/λ) du|²``, integrated over every pixel.

    Parameters
    ----------
    u_m : ndarray, (n,)
        Samples of the pupil along x and along y [m].
    amplitudes : mapping of (float, float) to ndarray, (n, n)
        Pupil amplitude, real or complex, for every `Ray.pupil`.
    area_m2 : float
        Clear area that stands for all the star's light.
    rays : sequence of Ray
        Those of one `Ray.pupil` share the field there.
    pixels : PixelGrid
    dtype : numpy.complex64 or numpy.complex128
    """

    def __init__(
        self,
        u_m: np.ndarray,
        amplitudes: Mapping[tuple[float, float], np.ndarray],
        area_m2: float,
        rays: Sequence[Ray],
        pixels: PixelGrid,
        dtype: type = np.complex128,
    ):
        self._dtype, self._pixels = dtype, pixels
        self._real = np.finfo(dtype).dtype
        self._amplitudes = {
            pupil: np.asarray(amplitude, dtype if np.iscomplexobj(amplitude) else self._real)
            for pupil, amplitude in amplitudes.items()
        }
        self._by_pupil: dict[tuple[float, float], list[tuple[Ray, np.ndarray, np.ndarray]]] = {}
        for ray in rays:
            self._by_pupil.setdefault(ray.pupil, []).append((ray, *self._matrices(u_m, ray)))
        # Parseval: the integral of |FT|² over all angles is λ² times the energy in the pupil.
        self._norm = ((u_m[1] - u_m[0]) ** 2 * MAS / NM) ** 2 / area_m2

    def _matrices(self, u_m: np.ndarray, ray: Ray) -> tuple[np.ndarray, np.ndarray]:
        """Fourier matrices (row nodes, n) and (n, column nodes)."""
        y_mas, x_mas = self._pixels.node_angles_mas()
        wavenumber = 2 * np.pi * MAS / (ray.wavelength_nm * NM)
        rows = np.exp(-1j * wavenumber * np.outer(y_mas - ray.offset_mas[1], u_m))
        columns = np.exp(-1j * wavenumber * np.outer(u_m, x_mas - ray.offset_mas[0]))
        return rows.astype(self._dtype), columns.astype(self._dtype)

    def images(self, opd_nm: np.ndarray) -> np.ndarray:
        """Images of wavefronts, in parts of the star's light.

        Parameters
        ----------
        opd_nm : ndarray, (times, n, n)

        Returns
        -------
        ndarray, (times, rows, columns), float64
        """
        batches = np.array_split(opd_nm, max(1, len(opd_nm) // BATCH))
        return np.concatenate([self._batch(np.asarray(batch, self._real)) for batch in batches])

    def _batch(self, opd_nm: np.ndarray) -> np.ndarray:
        intensity = np.zeros((), self._real)
        for pupil, paths in self._by_pupil.items():
            field = self._field(opd_nm, pupil)
            for ray, to_rows, to_columns in paths:
                focal = to_rows @ (field @ to_columns)
                scale = self._real.type(ray.weight * self._norm / ray.wavelength_nm**2)
                intensity = intensity + scale * (focal.real**2 + focal.imag**2)
        return self._pixels.integrated(intensity)

    def _field(self, opd_nm: np.ndarray, pupil: tuple[float, float]) -> np.ndarray:
        """Field in the pupil, (times, n, n)."""
        phase = opd_nm * self._real.type(2 * np.pi / pupil[0])
        field = np.empty(phase.shape, self._dtype)
        np.cos(phase, out=field.real)
        np.sin(phase, out=field.imag)
        field *= self._amplitudes[pupil]
        return field
