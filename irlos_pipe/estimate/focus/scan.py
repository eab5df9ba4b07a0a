"""Where the fit of one image begins: a scan of defocus and position that needs no earlier image.

As `starts.scan_start_nm`, the best of some templates by normalised cross-correlation; but images have no
frequencies beyond the optics' cut-off, and a star in a closed loop lies within a few pixels of its place.
A few frequencies and a few shifts are left, and the correlation is two small matrix products.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.fft import rfft2

from irlos_pipe.conventions.units import tilt_nm
from irlos_pipe.optics.focus_table import FocusTable

STEP_NM = 100.0  # between templates: the fit finds home from half of it
APART = 2  # templates between a maximum and what counts as another one
CUT = 0.4  # frequencies kept [cycles/px]: more than a table's images have


class Candidate(NamedTuple):
    """A maximum of the correlation.

    Attributes
    ----------
    tip_nm, tilt_nm, focus_nm : float
        Where it lies, between the templates and shifts [nm RMS].
    energy_e2 : float
        By how much the template, at its best brightness, lowers the sum of squares [e-²].
    """

    tip_nm: float
    tilt_nm: float
    focus_nm: float
    energy_e2: float


class FocusScan:
    """Templates of a `FocusTable` over its whole reach.

    Parameters
    ----------
    table : FocusTable
    """

    def __init__(self, table: FocusTable):
        low, high = table.reach.focus_nm
        self._focus_nm = np.linspace(low, high, int(np.ceil((high - low) / STEP_NM)) + 1)[1:-1]
        modes_nm = torch.zeros(len(self._focus_nm), 3, dtype=torch.float64)
        modes_nm[:, table.focus] = torch.as_tensor(self._focus_nm)
        rows, columns = table.settings.window
        self._kept = np.abs(np.fft.fftfreq(rows)) <= CUT, np.fft.rfftfreq(columns) <= CUT
        spectra = np.conj(self._spectrum(table.images(modes_nm).cpu().numpy()))
        count = np.where(np.fft.rfftfreq(columns)[self._kept[1]] > 0, 2.0, 1.0) / (rows * columns)
        norm = np.sqrt((np.abs(spectra) ** 2 * count).sum((1, 2), keepdims=True))
        self._spectra = (spectra / norm * count).astype(np.complex64)
        settings = table.settings
        self._pixel_nm = tilt_nm(settings.pixel_scale_mas, settings.geometry.diameter_m)
        shifts = int(np.ceil(table.reach.tilt_nm / self._pixel_nm))
        self._shifts = np.arange(-shifts, shifts + 1)
        along_y = np.fft.fftfreq(rows)[self._kept[0]]
        along_x = np.fft.rfftfreq(columns)[self._kept[1]]
        self._to_rows = np.exp(2j * np.pi * np.outer(self._shifts, along_y)).astype(np.complex64)
        self._to_columns = np.exp(2j * np.pi * np.outer(along_x, self._shifts)).astype(np.complex64)

    def __call__(self, image_e: np.ndarray) -> list[Candidate]:
        """Return the maxima along the focus, the highest first.

        Parameters
        ----------
        image_e : ndarray, (rows, columns)
            Bad pixels set to something harmless.
        """
        products = self._spectra * self._spectrum(image_e)
        along_x = (products.reshape(-1, products.shape[2]) @ self._to_columns).reshape(
            *products.shape[:2], -1
        )
        correlation = np.matmul(self._to_rows, along_x).real
        peaks = correlation.max((1, 2))
        return [self._candidate(correlation, peaks, one) for one in _maxima(peaks)]

    def _spectrum(self, images: np.ndarray) -> np.ndarray:
        """Frequencies kept, without the mean, complex64."""
        spectrum = rfft2(images.astype(np.float32, copy=False))[..., self._kept[0], :][..., self._kept[1]]
        spectrum[..., 0, 0] = 0
        return spectrum

    def _candidate(self, correlation: np.ndarray, peaks: np.ndarray, index: int) -> Candidate:
        row, column = np.unravel_index(correlation[index].argmax(), correlation.shape[1:])
        step = self._focus_nm[1] - self._focus_nm[0]
        return Candidate(
            float((self._shifts[column] + _vertex(correlation[index, row], column)) * self._pixel_nm),
            float((self._shifts[row] + _vertex(correlation[index, :, column], row)) * self._pixel_nm),
            float(self._focus_nm[index] + _vertex(peaks, index) * step),
            float(max(peaks[index], 0.0)) ** 2,
        )


def _maxima(peaks: np.ndarray) -> list[int]:
    """Positions that nothing within `APART` exceeds, the highest first."""
    found: list[int] = []
    for index in np.argsort(peaks)[::-1]:
        near = peaks[max(0, index - APART) : index + APART + 1]
        if peaks[index] == near.max():
            found.append(int(index))
    return found


def _vertex(values: np.ndarray, index: int) -> float:
    """Vertex of the parabola through a maximum and its neighbours, from the maximum [steps]; 0 at an end."""
    if index in (0, len(values) - 1):
        return 0.0
    before, here, after = values[index - 1 : index + 2]
    bend = before - 2 * here + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0
