"""Pixels of a strained image: scales that differ along two orthogonal axes, in any direction.

A point p of the window shows the direction ``a = s A p`` on the sky, with the pixel scale s and a symmetric
matrix A. Its off-diagonal element mixes x and y, so that the Fourier sum over the baselines b, ::

    I(p) = Σ_b O(b) S(b) exp(2πi b·A p s/λ),    S = sinc(b·A e_x s/λ) sinc(b·A e_y s/λ)

is no product of two matrices: S is the footprint of a pixel, whose edges are the vectors A e_x and A e_y. But
A is two shears and a scale on each axis. ::

    K(x, Y) = J(α x + β Y, Y),    I(x, y) = K(x, A_yy y + A_xy x),    α = det A / A_yy,  β = A_xy / A_yy

takes the image J on the focal grid line by line to the columns of pixels, and then these to their rows. A
shear is a phase in the Fourier transform along its direction. It lengthens baselines by up to |β| times their
other component; the lines lie as much closer as that needs, so that all this is as exact as without strain.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from irlos_pipe.conventions.units import MAS
from irlos_pipe.optics.fourier_matrices import (
    FocalGrid,
    half_plane_counts,
    phasor,
    quick_fft_length,
    require_field,
)
from irlos_pipe.optics.grids import Sampling
from irlos_pipe.optics.pupil import grid_centres

SYMMETRIC = torch.tensor([[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]], dtype=torch.float64)


def pixel_map(strain: torch.Tensor) -> torch.Tensor:
    """Return the matrix A (2, 2) from pixels to the sky, the inverse of the stretch ``(1 + E) / √(1 − ε²)``.

    E is the symmetric matrix without a trace whose first row are the components of the `strain`, (2,) as in
    `Sampling`, ε their norm. The determinant is one: the mean scale stays, and the light of a pixel.
    """
    return (torch.eye(2).double() - _matrix(strain)) / (1 - strain.square().sum()).sqrt()


def pixel_map_slope(strain: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """Return the derivative of `pixel_map` along a `change` of the `strain`, (2, 2)."""
    left = 1 - strain.square().sum()
    return pixel_map(strain) * (strain @ change) / left - _matrix(change) / left.sqrt()


def _matrix(strain: torch.Tensor) -> torch.Tensor:
    return torch.tensordot(strain, SYMMETRIC, 1)


class Strained(NamedTuple):
    """Matrices of one colour, from the real FFT of the focal intensity to pixel-integrated flux."""

    to_rows: torch.Tensor  # (rows, q//2 + 1): with the photon weight
    to_columns: torch.Tensor  # (columns, p//2 + 1)
    along_lines: torch.Tensor  # (q, p//2 + 1): phase that shears the lines, of which there are q in a period
    along_columns: torch.Tensor  # (q//2 + 1, columns): phase that shears the columns of pixels
    footprint: torch.Tensor  # (p, p//2 + 1)
    counts: torch.Tensor  # (q//2 + 1, 1): see `half_plane_counts`
    pixels: Pixels  # from which these are made

    @classmethod
    def of(
        cls, window: tuple[int, int], sampling: Sampling, index: int, grid: FocalGrid, like: torch.Tensor
    ) -> Strained:
        """Return those of a `window` (rows, columns) at the wavelength `index` of a `sampling`.

        They are complex, of the precision and on the device of `like`.

        Raises `ValueError` if the window is wider than the focal `grid`, which would alias silently.
        """
        pixels = Pixels(window, sampling, index, grid)
        made = pixels.rows, pixels.columns, pixels.along_lines, pixels.along_columns
        rows, columns, along_lines, along_columns = (one.to(like) for one in made)
        counts = torch.as_tensor(half_plane_counts(len(along_columns), len(along_lines)))[:, None]
        footprint, counts = (one.to(like.device, like.real.dtype) for one in (pixels.footprint, counts))
        return cls(rows, columns, along_lines, along_columns, footprint, counts, pixels)

    @property
    def single(self) -> Strained:
        waves = (self.to_rows, self.to_columns, self.along_lines, self.along_columns)
        rows, columns, along_lines, along_columns = (one.to(torch.complex64) for one in waves)
        real = self.footprint.float(), self.counts.float()
        return Strained(rows, columns, along_lines, along_columns, *real, self.pixels)

    def image(self, waves: torch.Tensor, footprint: torch.Tensor | None = None) -> torch.Tensor:
        """Return the weighted pixel flux of `waves` (..., p, p//2 + 1), the FFT of a focal intensity.

        Another `footprint` stands in for the own one.
        """
        seen = waves * (self.footprint if footprint is None else footprint)
        padded = seen.shape[-2]
        between = seen.new_zeros(*seen.shape[:-2], len(self.along_lines) - padded, seen.shape[-1])
        closer = torch.cat([seen[..., : padded // 2, :], between, seen[..., padded // 2 :, :]], dim=-2)
        lines = torch.fft.ifft(closer, dim=-2, norm="forward") * self.along_lines
        columns = lines.real @ self.to_columns.real.mT - lines.imag @ self.to_columns.imag.mT
        sheared = torch.fft.rfft(columns, dim=-2, norm="forward") * self.along_columns
        return self.to_rows.real @ sheared.real - self.to_rows.imag @ sheared.imag

    def adjoint(self, factors: torch.Tensor) -> torch.Tensor:
        """Return the transpose of `image` as a real linear map, conjugated: from pixels to waves."""
        sheared = (self.to_rows.mH @ factors.to(self.to_rows.dtype)) * self.along_columns.conj()
        period, padded = len(self.along_lines), len(self.footprint)
        columns = torch.fft.irfft(sheared / self.counts, n=period, dim=-2, norm="forward")
        lines = (columns.to(self.to_columns.dtype) @ self.to_columns.conj()) * self.along_lines.conj()
        waves = torch.fft.fft(lines, dim=-2, norm="forward")
        least, most = waves[..., : padded // 2, :], waves[..., period - padded + padded // 2 :, :]
        return torch.cat([least, most], dim=-2) * self.footprint

    def slopes(self, waves: torch.Tensor, changes: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Return the derivatives of `image` along `changes` of A, (2, 2) each.

        A point p moves by ``ΔA p``, and the edges of the pixels by its columns.
        """
        by_x, by_y = (self.image(waves, turn.to(waves)) for turn in self.pixels.gradients)
        found = []
        for change in changes:
            x, y = (one.to(by_x) for one in self.pixels.displacement(change))
            edges = self.pixels.footprint_slope(change).to(self.footprint)
            found.append(x * by_x + y * by_y + self.image(waves, edges))
        return found


class Pixels:
    """Where the pixels of a window lie on the sky in one colour, see `Strained.of`; differentiable."""

    def __init__(self, window: tuple[int, int], sampling: Sampling, index: int, grid: FocalGrid):
        self.map, self._grid = pixel_map(sampling.strain), grid
        scale_mas, wavelength_m = sampling.pixel_scale_mas, sampling.wavelengths_m[index]
        for across in self.map.detach().abs().sum(1).tolist():
            require_field(max(window), float(scale_mas.detach()) * across, float(wavelength_m.detach()), grid)
        self.size, self.weight = scale_mas * MAS / wavelength_m, sampling.weights[index]  # over baselines
        self._y, self._x = (torch.as_tensor(grid_centres(size, 1.0)) for size in window)
        self._by, self._bx = torch.as_tensor(grid.baseline_y_m)[:, None], torch.as_tensor(grid.baseline_x_m)
        self._shear = self.map[0, 1] / self.map[1, 1]
        self._lines = quick_fft_length(int(grid.padded * (1 + abs(float(self._shear.detach())))) + 1)

    @property
    def rows(self) -> torch.Tensor:
        return self.weight * self._waves(self.map[1, 1] * self._y, self._along_column, self._lines)

    @property
    def columns(self) -> torch.Tensor:
        return self._waves(self.map.det() / self.map[1, 1] * self._x, self._bx, self._grid.padded)

    @property
    def _along_column(self) -> torch.Tensor:
        """Baselines that lines resolve, (q//2 + 1,)."""
        finer = self._lines / self._grid.padded
        return torch.as_tensor(np.fft.rfftfreq(self._lines) * 2 * self._grid.width_m * finer)

    def _waves(self, places: torch.Tensor, baselines: torch.Tensor, period: int) -> torch.Tensor:
        """To pixels at `places`, from half of the waves along an axis."""
        grid = self._grid
        counts = torch.as_tensor(half_plane_counts(len(baselines), period))
        # The FFT counts from the first sample.
        waves = phasor(2 * np.pi * (self.size * places[:, None] - grid.frequency_per_m[0]) * baselines)
        return waves * (self.size * 2 * grid.width_m / grid.padded * counts)

    @property
    def along_lines(self) -> torch.Tensor:
        """See `Strained`. Half of the appended zeros lie before the first line."""
        grid = self._grid
        samples = np.arange(self._lines) * grid.padded / self._lines
        before = samples >= (grid.samples + grid.padded) / 2
        places = grid.frequency_per_m[0] + (samples - before * grid.padded) / (2 * grid.width_m)
        return phasor(2 * np.pi * self._shear * torch.as_tensor(places)[:, None] * self._bx)

    @property
    def along_columns(self) -> torch.Tensor:
        return phasor(2 * np.pi * self.size * self.map[0, 1] * self._along_column[:, None] * self._x)

    @property
    def footprint(self) -> torch.Tensor:
        x, y = self._edges(self.map)
        return torch.sinc(x) * torch.sinc(y)

    def footprint_slope(self, change: torch.Tensor) -> torch.Tensor:
        """Return the derivative of `footprint` along a `change` of A."""
        (x, y), (dx, dy) = self._edges(self.map), self._edges(change)
        return _sinc_slope(x) * dx * torch.sinc(y) + torch.sinc(x) * _sinc_slope(y) * dy

    def _edges(self, matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Products of the baselines with the pixel's edges A e_x and A e_y over λ, (p, p//2 + 1)."""
        x, y = (self.size * (self._bx * column[0] + self._by * column[1]) for column in matrix.mT)
        return x, y

    @property
    def gradients(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Footprints with which an image is its own derivative along x and y on the sky, per pixel."""
        turn = 2j * np.pi * self.size * self.footprint
        return turn * self._bx, turn * self._by

    def displacement(self, change: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return where pixels move with a `change` of A: along x and y, (rows, columns) [px]."""
        x, y = self._x, self._y[:, None]
        return change[0, 0] * x + change[0, 1] * y, change[1, 0] * x + change[1, 1] * y


def _sinc_slope(x: torch.Tensor) -> torch.Tensor:
    safe = torch.where(x == 0, torch.ones_like(x), x)
    return torch.where(x == 0, torch.zeros_like(x), (torch.cos(np.pi * x) - torch.sinc(x)) / safe)
