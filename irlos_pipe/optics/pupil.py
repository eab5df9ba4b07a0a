"""The telescope pupil sampled by area."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..geometry import PupilGeometry, Vane

SUBSAMPLES = 16  # fine cells per side of a coarse cell; coverage of a fine cell is linear in distance
PAD = 4  # coarse cells beyond the diameter on each side: room for the filter's ringing
PASS_BAND, STOP_BAND = 0.7, 1.4  # of the low-pass, in units of the coarse grid's Nyquist frequency
CLEAN_BAND = min(PASS_BAND, 2 - STOP_BAND)  # neither attenuated nor reached by what folds back


def grid_centres(samples: int, step_m: float) -> np.ndarray:
    """Coordinates of `samples` points `step_m` apart, symmetric about 0 [m]."""
    return (np.arange(samples) - (samples - 1) / 2) * step_m


def area_weighted_pupil(geometry: PupilGeometry, centres_m: np.ndarray) -> np.ndarray:
    """Transmitted area fraction of every cell of a square grid.

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
    step = centres_m[1] - centres_m[0]
    rows = [
        _clear_fraction(geometry, centres_m[None, :], y[:, None], step)
        for y in np.array_split(centres_m, max(1, len(centres_m) // 64))
    ]
    return np.concatenate(rows)


@lru_cache(maxsize=8)
def band_limited_pupil(geometry: PupilGeometry, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Pupil amplitude whose sampled spectrum is that of the sharp-edged pupil where it matters.

    The area-weighted pupil of a grid `SUBSAMPLES` times finer is low-passed: flat up to
    0.7 of the coarse grid's Nyquist frequency (with the sinc of the fine cell taken out),
    a squared cosine to zero at 1.4 times it. A window of a few tens of lambda/D sees only
    the flat part, so sharp edges and thin vanes cost no resolution: at equal accuracy the
    grid is about half as fine per axis as an area-weighted one.

    Returns
    -------
    u_m : ndarray, (samples + 2 * PAD,)
        Coordinates of the grid [m]; `samples` of them lie across the diameter.
    amplitude : ndarray, (len(u_m), len(u_m))
        May ring slightly below 0 and above 1.
    """
    step = geometry.diameter_m / samples
    total = samples + 2 * PAD
    fine = grid_centres(total * SUBSAMPLES, step / SUBSAMPLES)
    response, half_cell = _low_pass(len(fine))
    spectrum = np.fft.fft2(area_weighted_pupil(geometry, fine))
    kernel = response * half_cell
    filtered = np.fft.ifft2(spectrum * kernel[:, None] * kernel[None, :]).real
    pick = slice(SUBSAMPLES // 2 - 1, None, SUBSAMPLES)
    u_m, amplitude = grid_centres(total, step), np.ascontiguousarray(filtered[pick, pick])
    u_m.flags.writeable = amplitude.flags.writeable = False  # they are shared by all callers
    return u_m, amplitude


def _low_pass(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Low-pass of the fine grid, and the half-cell shift that centres the picked samples."""
    cycles = np.fft.fftfreq(size)  # per fine cell
    nyquists = np.abs(cycles) * 2 * SUBSAMPLES
    ramp = np.clip((nyquists - PASS_BAND) / (STOP_BAND - PASS_BAND), 0, 1)
    return np.cos(np.pi / 2 * ramp) ** 2 / np.sinc(cycles), np.exp(1j * np.pi * cycles)


def _clear_fraction(geometry: PupilGeometry, x: np.ndarray, y: np.ndarray, step: float) -> np.ndarray:
    """Fraction of sub-cells of size `step` that transmit, from the distance to each edge."""
    radius = np.hypot(x, y)
    clear = _inside((geometry.diameter_m / 2 - radius) / step)
    if geometry.obscuration_m > 0:
        clear = clear * _inside((radius - geometry.obscuration_m / 2) / step)
    for vane in geometry.vanes:
        clear = clear * (1 - _vane_cover(vane, x, y, step))
    return clear


def _inside(distance_cells: np.ndarray) -> np.ndarray:
    """Covered fraction of a cell whose centre lies `distance_cells` inside an edge."""
    return np.clip(distance_cells + 0.5, 0.0, 1.0)


def _vane_cover(vane: Vane, x: np.ndarray, y: np.ndarray, step: float) -> np.ndarray:
    """Fraction of each sub-cell that the vane covers."""
    start, end = np.array(vane.start_m), np.array(vane.end_m)
    length = np.hypot(*(end - start))
    along_x, along_y = (end - start) / length
    along = (x - start[0]) * along_x + (y - start[1]) * along_y
    across = -(x - start[0]) * along_y + (y - start[1]) * along_x
    half = vane.width_m / 2
    width = _inside((across + half) / step) + _inside((half - across) / step) - 1
    return np.clip(width, 0, 1) * _inside(along / step) * _inside((length - along) / step)
