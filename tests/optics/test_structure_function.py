"""Turbulence beyond the correction band.

Truth: adaptive quadrature with Bessel functions, and the closed form of von Kármán's structure function.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.optics_cases import BAND, RESIDUAL_LAW, settings
from scipy.integrate import quad
from scipy.special import gamma, j0, kv

from irlos_pipe.effects import SeeingHalo
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.structure_function import (
    ResidualBand,
    fitting_structure_nm2,
    fitting_variance_nm2,
    seeing_to_r0_m,
    von_karman_nm2,
)

LENGTHS_M = np.array([0.05, 0.2, 0.5, 1.0, 2.0, 3.0, 4.0, 5.5, 7.0, 8.0])
R0_M = 0.2


def von_karman_structure_nm2(b_m: float, outer_scale_m: float) -> float:
    """Closed form, e.g. Conan 2000; D(inf) is twice the variance 0.0859 (L0/r0)^(5/3) rad²."""
    z = 2 * np.pi * b_m / outer_scale_m
    constant = 2 * 0.0229 * 6 * np.pi / 5 * (outer_scale_m / R0_M) ** (5 / 3)
    return constant * (1 - 2 ** (1 / 6) / gamma(5 / 6) * z ** (5 / 6) * kv(5 / 6, z)) * (500 / 2 / np.pi) ** 2


def test_the_uncorrected_turbulence_is_von_karman_less_its_corrected_part():
    def below_cutoff(b):
        return quad(
            lambda f: 4 * np.pi * f * von_karman_nm2(f, R0_M, 25.0) * (1 - j0(2 * np.pi * f * b)),
            0,
            BAND.cutoff_per_m,
            limit=1000,
        )[0]

    exact = [von_karman_structure_nm2(b, 25.0) - below_cutoff(b) for b in LENGTHS_M]
    ours = fitting_structure_nm2(LENGTHS_M, BAND, R0_M)
    assert ours == pytest.approx(np.array(exact), abs=2e-3 * 2 * fitting_variance_nm2(BAND, R0_M))


def test_the_variance_beyond_the_cut_off_has_its_closed_form():
    distant = ResidualBand(BAND.low_per_m, BAND.cutoff_per_m, outer_scale_m=1e6)
    kolmogorov = (
        0.0229 * 6 * np.pi / 5 * R0_M ** (-5 / 3) * BAND.cutoff_per_m ** (-5 / 3) * (500 / 2 / np.pi) ** 2
    )
    assert fitting_variance_nm2(distant, R0_M) == pytest.approx(kolmogorov, rel=1e-4)


def test_turbulence_beyond_the_cut_off_adds_to_the_residual_inside():
    grids = PsfModel(settings(24), (4,)).grids
    grid = OtfGrid.of(grids.focal, grids.sampling)
    values = torch.tensor([100.0**2, 2.0, *[0.0] * 5], dtype=torch.float64)
    inside, both = (
        SeeingHalo(BAND, RESIDUAL_LAW, seeing).exponent(values, grid)[0] for seeing in (1e-4, 0.8)
    )
    lengths = np.hypot(grid.baseline_x_m[None], grid.baseline_y_m[:, None])
    beyond = 0.5 * (2 * np.pi / 1600) ** 2 * fitting_structure_nm2(lengths, BAND, seeing_to_r0_m(0.8))
    within = lengths < 8.0  # no two points of the pupil are further apart
    assert (both - inside).numpy()[within] == pytest.approx(beyond[within], abs=1e-5)
