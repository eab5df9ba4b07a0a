"""The transform from pupil to focal plane in real arithmetic.

Truth: the complex Fourier sum of the same samples, written out with NumPy (analysis).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.polynomial import chebyshev

from irlos_pipe.optics.fourier_matrices import FocalGrid, MatrixDft, mirrored, products_up_to
from irlos_pipe.optics.pupil import grid_centres

STEP_M, FRAMES = 0.25, 2


def fields(samples: int) -> np.ndarray:
    real, imag = np.random.default_rng(samples).standard_normal((2, FRAMES, samples, samples))
    return real + 1j * imag


def as_real(field: np.ndarray) -> torch.Tensor:
    return mirrored(torch.as_tensor(np.stack([field.real, field.imag], axis=1)))


def as_complex(amplitude: torch.Tensor) -> np.ndarray:
    return torch.complex(*amplitude.unbind(-3)).numpy()


class Case:
    """A transform, and the complex matrix of the same grids."""

    def __init__(self, samples: int, focal: int, degree: int):
        self.u_m = grid_centres(samples, STEP_M)
        grid = FocalGrid(focal, samples * STEP_M, 2 * focal, samples * STEP_M)
        self.polynomials = chebyshev.chebvander(self.u_m / self.u_m[-1], degree).T
        self.dft = MatrixDft(self.u_m, grid, self.polynomials, torch.zeros((), dtype=torch.float64))
        self.matrix = np.exp(-2j * np.pi * np.outer(grid.frequency_per_m, self.u_m)) * STEP_M


@pytest.fixture(params=[(24, 12, 5), (14, 20, 4), (16, 9, 0)], ids=str)
def case(request) -> Case:
    return Case(*request.param)


def test_the_amplitude_is_the_fourier_sum(case):
    field = fields(len(case.u_m))
    truth = case.matrix @ field @ case.matrix.T
    ours = as_complex(case.dft.amplitude(as_real(field)))
    assert ours == pytest.approx(truth, abs=1e-12 * abs(truth).max())


def test_the_adjoint_is_the_transpose(case):
    """``<A E, V> = <E, Aᵀ V>`` for any field and any amplitude."""
    field = as_real(fields(len(case.u_m)))
    amplitude = case.dft.amplitude(field)
    other = torch.as_tensor(np.random.default_rng(2).standard_normal(amplitude.shape))
    assert (case.dft.adjoint(other) * field).sum().item() == pytest.approx((amplitude * other).sum().item())


def test_products_are_the_fourier_sums_of_the_field_times_polynomials(case):
    field = fields(len(case.u_m))
    found = np.concatenate([as_complex(part) for part in case.dft.products(as_real(field))])
    for (a, b), ours in zip(products_up_to(len(case.polynomials) - 1), found, strict=True):
        weighted = field * case.polynomials[b][:, None] * case.polynomials[a]
        truth = (-1j) ** (a % 2 + b % 2) * (case.matrix @ weighted @ case.matrix.T)
        assert ours == pytest.approx(truth, abs=1e-12 * abs(truth).max()), (a, b)
