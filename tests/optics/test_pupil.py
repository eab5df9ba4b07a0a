"""The sampled pupil. Truth: areas and Fourier transforms by analysis, and the aperture of HCIPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.optics_cases import UT4
from helpers.reference_psf import reference
from scipy.special import j1

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.pupil_parts import Circle, Placement
from irlos_pipe.optics.fourier_matrices import require_resolved
from irlos_pipe.optics.pupil import (
    CLEAN_BAND,
    area_weighted_pupil,
    band_limited,
    band_limited_pupil,
    grid_centres,
)

RING = PupilGeometry(8.0, 1.116)


def sampled(geometry: PupilGeometry, samples: int = 256) -> tuple[np.ndarray, np.ndarray, float]:
    step = geometry.diameter_m / samples
    centres = grid_centres(samples, step)
    return centres, area_weighted_pupil(geometry, centres), step


def test_the_ut4_pupil_is_that_of_an_independent_library():
    theirs, ours = (binned(pupil) for pupil in (reference().transmission, sampled(UT4, 1024)[1]))
    assert ours.sum() == pytest.approx(theirs.sum(), rel=1e-5)
    # they count 32 x 32 points in a cell: an edge along a row of points moves 1/32 of it
    assert np.abs(ours - theirs).max() < 1 / 32


def binned(pupil: np.ndarray) -> np.ndarray:
    """Means over 8 x 8 cells of a grid of 1024 x 1024."""
    return pupil.reshape(128, 8, 128, 8).mean((1, 3))


def spectrum(u: np.ndarray, amplitude: np.ndarray, frequency_per_m: np.ndarray) -> np.ndarray:
    """Fourier sum along the diagonal and both axes of the frequency plane."""
    waves = np.exp(-2j * np.pi * np.outer(frequency_per_m, u))
    return (waves @ amplitude @ waves.T) * (u[1] - u[0]) ** 2


def test_the_band_limited_pupil_has_the_spectrum_of_the_sharp_edge():
    u, amplitude = band_limited_pupil(RING, 96)
    reach = CLEAN_BAND / (2 * (u[1] - u[0]))
    f = np.linspace(-reach, reach, 41)
    radius = np.hypot(f[:, None], f[None])

    def disc(diameter):
        z = np.maximum(np.pi * diameter * radius, 1e-12)
        return np.pi * diameter**2 / 2 * j1(z) / z

    exact = np.where(radius <= reach, disc(8.0) - disc(1.116), 0)
    ours = np.where(radius <= reach, spectrum(u, amplitude, f), 0)
    assert np.abs(ours - exact).max() < 1e-5 * exact.max()


@pytest.mark.parametrize("stop_m", [(0.0, 0.0), (0.11, -0.07)], ids=["on axis", "displaced"])
@pytest.mark.parametrize("geometry", [UT4, RING, PupilGeometry(8.0)], ids=["vanes", "ring", "disc"])
def test_cells_away_from_the_edges_are_all_clear_or_all_dark(geometry, stop_m):
    """Truth: every fine cell drawn by itself, as where an obstruction is drawn; this one covers nothing."""
    nowhere = Circle(1e-6).placed(Placement.of(0.0, "none", (3.99, 3.99)))
    every = replace(geometry, obstructions=(nowhere,))
    assert geometry.plain and not every.plain
    ours, theirs = (band_limited(one, 48, stop_m=stop_m, subsamples=8) for one in (geometry, every))
    assert ours == pytest.approx(theirs, abs=1e-12)


def test_a_window_beyond_what_the_grid_resolves_is_refused():
    step_m, wavelength_m = 0.0625, 1.6e-6
    field_mas = CLEAN_BAND * wavelength_m / step_m / np.deg2rad(1 / 3.6e6)
    require_resolved(64, 0.999 * field_mas / 64, wavelength_m, step_m)
    with pytest.raises(ValueError, match=r"1\.5 times as many pupil samples"):
        require_resolved(64, 1.5 * field_mas / 64, wavelength_m, step_m)
