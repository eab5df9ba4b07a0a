"""From the pupil to the pixels of a window: focal grids, transforms and pixel matrices by wavelength."""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.optics.fourier_matrices import (
    FocalGrid,
    baseline_to_pixels,
    focal_samples_for,
    focal_to_pixels,
    quick_fft_length,
    require_resolved,
)
from irlos_pipe.optics.grids import PupilGrid, Sampling
from irlos_pipe.optics.matrix_dft import MatrixDft
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.strained import Strained

COMPLEX = {torch.float32: torch.complex64, torch.float64: torch.complex128}
Matrices = tuple[torch.Tensor, torch.Tensor]


class FocalPlane:
    """Where light of every wavelength falls on the pixels of one window.

    The `settings` give window, pixel scale and margins, `sampling` wavelengths and weights as built; the
    `polynomials`, (degree + 1, n), are those of `MatrixDft`. Matrices have the precision and device of
    `like`.
    """

    def __init__(
        self,
        settings: PsfSettings,
        sampling: Sampling,
        pupil: PupilGrid,
        polynomials: np.ndarray,
        like: torch.Tensor,
    ):
        self.window, self.sampling, self.like = settings.window, sampling, like
        # One per wavelength: long waves need fewer samples; the baselines are common.
        self.grids = _focal_grids(settings, sampling.wavelengths_m.numpy(), pupil)
        self.dfts = [MatrixDft(pupil.u_m, focal, polynomials, like) for focal in self.grids]

    @property
    def widest(self) -> FocalGrid:
        """The grid with most samples."""
        return max(self.grids, key=lambda grid: grid.samples)

    def to_pixels(self, index: int, sampling: Sampling | None, *, filtered: bool) -> Matrices:
        """Return matrices to rows, weighted, and to columns, at the wavelength `index`.

        A `sampling` is given where effects change it. Matrices are applied to the real FFT of the focal
        intensity if `filtered`, otherwise to the intensity itself.
        """
        make = self._filtered_matrices if filtered else self._plain_matrices
        return make(index, sampling or self.sampling)

    def pixel_slopes(self, index: int, sampling: Sampling, *, filtered: bool) -> Matrices:
        """Return the derivatives of `to_pixels` by the logarithm of pixel scale over wavelength."""
        make = self._filtered_matrices if filtered else self._plain_matrices
        return make(index, sampling, slope=True)

    def strained(self, index: int, sampling: Sampling) -> Strained:
        """Return the matrices to pixels of a strained image, at the wavelength `index`."""
        like = self.like.new_empty(0, dtype=COMPLEX[self.like.dtype])
        return Strained.of(self.window, sampling, index, self.grids[index], like)

    def _plain_matrices(self, index: int, sampling: Sampling, *, slope: bool = False) -> Matrices:
        sky = sampling.pixel_scale_mas, sampling.wavelengths_m[index], self.grids[index]
        made = {px: focal_to_pixels(px, *sky, slope=slope) for px in {*self.window}}
        rows, columns = (made[px] for px in self.window)
        return (sampling.weights[index] * rows).to(self.like), columns.to(self.like)

    def _filtered_matrices(self, index: int, sampling: Sampling, *, slope: bool = False) -> Matrices:
        grid = self.grids[index]
        (rows, columns), sky = self.window, (sampling.pixel_scale_mas, sampling.wavelengths_m[index], grid)
        along_y = baseline_to_pixels(grid.baseline_y_m, rows, *sky, half=False, slope=slope)
        along_x = baseline_to_pixels(grid.baseline_x_m, columns, *sky, half=True, slope=slope)
        device, dtype = self.like.device, COMPLEX[self.like.dtype]
        return (sampling.weights[index] * along_y).to(device, dtype), along_x.to(device, dtype)


def _focal_grids(settings: PsfSettings, wavelengths_m: np.ndarray, pupil: PupilGrid) -> list[FocalGrid]:
    scale_mas, window_px = settings.pixel_scale_mas, max(settings.window)
    require_resolved(window_px, scale_mas, wavelengths_m.min(), pupil.u_m[1] - pupil.u_m[0])

    def samples(margin_mas: float, wavelength_m: float) -> int:
        return focal_samples_for(window_px, scale_mas, margin_mas, wavelength_m, pupil.width_m)

    needed = [samples(settings.margin_mas, wavelength_m) for wavelength_m in wavelengths_m]
    period = samples(settings.halo_margin_mas, wavelengths_m.min())
    padded = quick_fft_length(max(*needed, period))
    return [FocalGrid(count, pupil.width_m, padded, pupil.longest_m) for count in needed]
