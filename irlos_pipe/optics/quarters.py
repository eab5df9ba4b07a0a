"""The quarters of a pupil, each on a grid of its own.

An image does not know where in the pupil its light has passed, so a quarter is sampled about its own middle.
Its grid is about half as wide as the pupil's: its focal grid needs half as many samples per axis, and its OTF
half as many baselines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.pupil import Division, band_limited_parts, grid_centres

RINGING = 6  # samples beyond the axes: those left out would change images by 1e-5 of the peak
DARK, FAINT = 1e-12, 0.02  # of the largest amplitude
BEYOND = 0.5  # by which the band-limited parts of a faint amplitude may ring over it


@dataclass(frozen=True, eq=False, kw_only=True)
class Quarter(PupilGrid):
    """Samples of a quarter of the pupil, about its middle.

    Attributes
    ----------
    place : (slice, slice)
        Rows and columns of the pupil's grid.
    clear : ndarray, (n, n)
        Amplitude of the quarter before its light is counted.
    weights : tensor, (n, n)
        By what to multiply the amplitude of the pupil there to get that of the quarter.
    """

    place: tuple[slice, slice]
    clear: np.ndarray
    weights: torch.Tensor

    @property
    def amplitude(self) -> np.ndarray:
        """See `PupilGrid.amplitude`."""
        return self.clear * self.light

    @property
    def longest_m(self) -> float:
        """See `PupilGrid.longest_m`: from corner to corner."""
        return float(np.hypot(self.width_m, self.width_m))

    def modes(self, nolls: Sequence[int]) -> np.ndarray:
        """See `PupilGrid.modes`: those of the whole pupil."""
        return super().modes(nolls)[:, *self.place]

    def through(self, pupil: torch.Tensor) -> torch.Tensor:
        """Return the part of a disturbed `pupil`, from (wavelengths, m, m) to (wavelengths, n, n)."""
        return pupil[:, *self.place] * self.weights


def quarters(pupil: PupilGrid) -> list[Quarter]:
    """Return the four quarters of a `pupil`: lower left, lower right, upper left, upper right."""
    drawn = np.where(pupil.lit, _drawn(pupil.geometry, pupil.samples), 0)
    whole, total = pupil.amplitude / pupil.light, len(pupil.u_m)
    size = total // 2 + RINGING
    size += size % 2  # `MatrixDft` folds the grid
    halves = slice(size), slice(total - size, total)
    own = replace(pupil, u_m=grid_centres(size, pupil.u_m[1] - pupil.u_m[0]))
    found = []
    for clear, place in zip(drawn, product(halves, halves), strict=True):
        middle_y, middle_x = (float(pupil.u_m[one].mean()) for one in place)
        weights = _weights(whole, clear)[place] * own.light / pupil.light
        grid = {**vars(own), "middle_m": (middle_x, middle_y)}
        found.append(Quarter(**grid, place=place, clear=clear[place], weights=torch.as_tensor(weights)))
    return found


@lru_cache(maxsize=8)
def _drawn(geometry: PupilGeometry, samples: int) -> np.ndarray:
    """Amplitudes of the quarters of a pupil, (4, n, n), on the grid of `band_limited_pupil`."""
    return band_limited_parts(geometry, samples, Division(lambda x_m, y_m: 2 * (y_m > 0) + (x_m > 0), 4))


def _weights(whole: np.ndarray, part: np.ndarray) -> np.ndarray:
    """By what to multiply an amplitude to get that of a part, (n, n).

    They are ratios of amplitudes: what an effect does to the light of the pupil it does to that of a part.
    Where there is hardly light, the ratio is held near 0 to 1.
    """
    seen = np.abs(whole) > DARK * np.abs(whole).max()
    ratio = np.divide(part, whole, out=np.zeros_like(part), where=seen)
    faint = np.abs(whole) < FAINT * np.abs(whole).max()
    return np.where(faint, ratio.clip(-BEYOND, 1 + BEYOND), ratio)
