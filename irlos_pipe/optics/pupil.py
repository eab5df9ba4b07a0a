"""The telescope pupil sampled by area."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane
from irlos_pipe.optics.pupil_blocks import filtered_in_blocks
from irlos_pipe.optics.pupil_cover import ON_AXIS, across_m, outline_cover, parts_cover, vane_cover

SUBSAMPLES = 16  # fine cells per side of a coarse cell; coverage of a fine cell is linear in distance
ROWS_AT_A_TIME = 64
NOTHING_BEFORE_IT: dict = {"obscuration_m": 0.0, "vanes": (), "obstructions": ()}  # before an aperture
PAD = 4  # coarse cells beyond the diameter on each side: room for the filter's ringing
PASS_BAND, STOP_BAND = 0.7, 1.4  # of the low-pass, in units of the coarse grid's Nyquist frequency
Shares = Callable[[np.ndarray, np.ndarray, float], Iterable[tuple[int, slice, np.ndarray]]]
Index = Callable[[np.ndarray, np.ndarray], np.ndarray]  # number of the part at points (x, y) [m]
CLEAN_BAND = min(PASS_BAND, 2 - STOP_BAND)  # neither attenuated nor reached by what folds back


@dataclass(frozen=True)
class Division:
    """Parts of a pupil that meet where there is no light.

    Attributes
    ----------
    index : callable
        Number of the part at, or nearest to, points; arrays that broadcast.
    count : int
    """

    index: Index
    count: int

    def shares(
        self, x_m: np.ndarray, y_m: np.ndarray, step_m: float
    ) -> Iterator[tuple[int, slice, np.ndarray]]:
        """See `band_limited_parts`: a cell belongs to one part."""
        index = self.index(x_m, y_m)
        for number in np.unique(index).tolist():
            inside = index == number
            columns = np.flatnonzero(inside.any(0))
            touched = slice(int(columns[0]), int(columns[-1]) + 1)
            yield number, touched, inside[:, touched]


def grid_centres(samples: int, step_m: float) -> np.ndarray:
    """Return the coordinates of `samples` points `step_m` apart, symmetric about 0 [m]."""
    return (np.arange(samples) - (samples - 1) / 2) * step_m


def area_weighted_pupil(geometry: PupilGeometry, centres_m: np.ndarray) -> np.ndarray:
    """Return the transmitted area fraction of every cell of a square grid.

    Parameters
    ----------
    geometry : PupilGeometry
    centres_m : ndarray, (samples,)
        Equally spaced cell centres along x and along y [m].

    Returns
    -------
    ndarray, (samples, samples), float64
        Row index is y, column index is x; values between 0 and 1.
    """
    return np.concatenate([clear for _, clear in _by_rows(geometry, centres_m, ON_AXIS)])


@lru_cache(maxsize=8)
def band_limited_pupil(geometry: PupilGeometry, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pupil amplitude whose sampled spectrum is that of the sharp-edged pupil where it matters.

    The area-weighted pupil of a grid `SUBSAMPLES` times finer is low-passed: flat up to
    0.7 of the coarse grid's Nyquist frequency (with the sinc of the fine cell taken out),
    a squared cosine to zero at 1.4 times it. A window of a few tens of lambda/D sees only
    the flat part, so sharp edges and thin vanes cost no resolution: at equal accuracy the
    grid is about half as fine per axis as an area-weighted one.

    Parameters
    ----------
    geometry : PupilGeometry
    samples : int
        Across the diameter.

    Returns
    -------
    u_m : ndarray, (samples + 2 * PAD,)
        Coordinates of the grid [m]; `samples` of them lie across the diameter.
    amplitude : ndarray, (len(u_m), len(u_m))
        May ring slightly below 0 and above 1.
    """
    total = samples + 2 * PAD
    u_m, amplitude = grid_centres(total, geometry.diameter_m / samples), band_limited(geometry, samples)
    u_m.flags.writeable = amplitude.flags.writeable = False  # they are shared by all callers
    return u_m, amplitude


@lru_cache(maxsize=8)
def transmitted_cells(geometry: PupilGeometry, samples: int) -> float:
    """Return the light that a pupil passes, as a number of clear cells of `band_limited_pupil`.

    `geometry` and `samples` are those of the pupil.
    """
    if geometry.map is None:
        # The pupil is clear or opaque, so ∫P² = ∫P, and the mean survives the band limit.
        return float(np.sum(band_limited_pupil(geometry, samples)[1]))
    fine, alone = fine_centres(geometry, samples, SUBSAMPLES), replace(geometry, **NOTHING_BEFORE_IT)
    kept, whole = (
        sum(float(np.sum(clear**2)) for _, clear in _by_rows(pupil, fine, ON_AXIS))
        for pupil in (geometry, alone)
    )
    return geometry.map.light_m2 / (geometry.diameter_m / samples) ** 2 * kept / whole


def band_limited(
    geometry: PupilGeometry,
    samples: int,
    *,
    stop_m: tuple[float, float] = ON_AXIS,
    subsamples: int = SUBSAMPLES,
) -> np.ndarray:
    """Return the amplitude of a pupil as in `band_limited_pupil`, (n, n).

    Parameters
    ----------
    geometry : PupilGeometry
    samples : int
        Across the diameter.
    stop_m : (float, float)
        Position of an internal stop that has the outline and the hole of the pupil, but no vanes.
    subsamples : int
        Fine cells per side of a coarse cell.
    """
    return _filtered(geometry, samples, stop_m, subsamples)


def band_limited_parts(
    geometry: PupilGeometry,
    samples: int,
    count: int,
    shares: Shares,
    *,
    stop_m: tuple[float, float] = ON_AXIS,
    subsamples: int = SUBSAMPLES,
) -> np.ndarray:
    """Return the amplitudes of the parts of a pupil, (count, n, n); their sum is that of the pupil.

    Parameters
    ----------
    geometry, samples, stop_m, subsamples : see `band_limited`
    count : int
        Number of parts.
    shares : callable
        ``shares(x_m, y_m, step_m)`` of a row and a column of cells gives, for parts that they touch, the
        number of the part, a slice of columns, and which share of the light of each cell there is its.
    """
    fine = fine_centres(geometry, samples, subsamples)
    filtering, step = filter_matrix(samples + 2 * PAD, subsamples), float(fine[1] - fine[0])
    found = np.zeros((count, len(filtering), len(filtering)))
    for rows, clear in _by_rows(geometry, fine, stop_m):
        for number, columns, share in shares(fine[None, :], fine[rows, None], step):
            found[number] += filtering[:, rows] @ ((clear[:, columns] * share) @ filtering[:, columns].T)
    return found


def _filtered(
    geometry: PupilGeometry, samples: int, stop_m: tuple[float, float], subsamples: int
) -> np.ndarray:
    """Low-passed clear fraction of the fine cells, (n, n)."""
    fine = fine_centres(geometry, samples, subsamples)
    filtering = filter_matrix(samples + 2 * PAD, subsamples)
    if geometry.plain:
        return filtered_in_blocks(geometry, fine, filtering, stop_m)
    return sum(filtering[:, rows] @ (clear @ filtering.T) for rows, clear in _by_rows(geometry, fine, stop_m))


def fine_centres(geometry: PupilGeometry, samples: int, subsamples: int) -> np.ndarray:
    """Coordinates along either axis [m] of a grid with `subsamples` per sample of `band_limited_pupil`.

    `geometry` and `samples` are those of the pupil.
    """
    return grid_centres((samples + 2 * PAD) * subsamples, geometry.diameter_m / samples / subsamples)


@lru_cache(maxsize=8)
def filter_matrix(total: int, subsamples: int) -> np.ndarray:
    """Low-pass along one axis of the fine grid that picks the coarse samples, (total, total · subsamples).

    `total` is the number of coarse samples, each of `subsamples` fine ones.
    """
    size = total * subsamples
    response, half_cell = _low_pass(size, subsamples)
    impulse = np.fft.ifft(response * half_cell).real
    picked = np.arange(total) * subsamples + subsamples // 2 - 1
    return impulse[(picked[:, None] - np.arange(size)[None, :]) % size]


def _low_pass(size: int, subsamples: int) -> tuple[np.ndarray, np.ndarray]:
    """Low-pass of the fine grid, and the half-cell shift that centres the picked samples."""
    cycles = np.fft.fftfreq(size)  # per fine cell
    nyquists = np.abs(cycles) * 2 * subsamples
    ramp = np.clip((nyquists - PASS_BAND) / (STOP_BAND - PASS_BAND), 0, 1)
    return np.cos(np.pi / 2 * ramp) ** 2 / np.sinc(cycles), np.exp(1j * np.pi * cycles)


def _by_rows(
    geometry: PupilGeometry, centres_m: np.ndarray, stop_m: tuple[float, float]
) -> Iterator[tuple[slice, np.ndarray]]:
    """Clear fraction of the cells, a few rows at a time, with the rows they are."""
    step = centres_m[1] - centres_m[0]
    for first in range(0, len(centres_m), ROWS_AT_A_TIME):
        rows = slice(first, first + ROWS_AT_A_TIME)
        yield rows, _clear_fraction(geometry, centres_m[None, :], centres_m[rows, None], step, stop_m)


def _clear_fraction(
    geometry: PupilGeometry, x: np.ndarray, y: np.ndarray, step: float, stop_m: tuple[float, float]
) -> np.ndarray:
    """Fraction of sub-cells of size `step` that transmit, from the distance to each edge."""
    clear = outline_cover(geometry, x, y, step, stop_m)
    for part in geometry.obstructions:
        clear *= 1 - parts_cover([part], x, y, step)
    for vane in geometry.vanes:
        _cover(clear, vane, x, y, step)
    return clear


def _cover(clear: np.ndarray, vane: Vane, x: np.ndarray, y: np.ndarray, step: float) -> None:
    """Take from every sub-cell the fraction that the vane covers; most lie far from it."""
    rows, columns = np.nonzero(np.abs(across_m(vane, x, y)) < vane.width_m / 2 + step)
    clear[rows, columns] *= 1 - vane_cover(vane, x[0, columns], y[rows, 0], step)
