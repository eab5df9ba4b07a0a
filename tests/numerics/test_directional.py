"""Derivatives along directions, alone and from several threads at once; truth: analysis."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from irlos_pipe.numerics.directional import Directional, along_all

VALUES = torch.tensor([0.3, -1.2, 2.0], dtype=torch.float64)
FACTORS = torch.arange(1, 4, dtype=torch.float64)


def waves(values: torch.Tensor) -> torch.Tensor:
    return torch.exp(1j * FACTORS * values).sum() * torch.ones(2, dtype=torch.float64)


def slopes_of_waves(values: torch.Tensor) -> np.ndarray:
    one = 1j * FACTORS.numpy() * np.exp(1j * FACTORS.numpy() * values.numpy())
    return np.stack([one, one], axis=1)


def squares(values: torch.Tensor) -> torch.Tensor:
    return values**2


def test_derivatives_of_a_complex_function_along_all_elements():
    assert along_all(waves, VALUES).numpy() == pytest.approx(slopes_of_waves(VALUES), rel=1e-12)


def test_derivatives_by_one_element_and_along_a_direction():
    direction = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    change = Directional(squares, VALUES)
    assert change.by(1).tolist() == pytest.approx([0.0, -2.4, 0.0])
    assert change.along(direction).tolist() == pytest.approx([0.6, -4.8, 0.0])


@pytest.mark.slow
def test_threads_do_not_meet_in_their_derivatives():
    def all_of_them(scale: float) -> torch.Tensor:
        values = scale * VALUES
        single = along_all(lambda v: (v**3).sum()[None], values[:1])
        return torch.cat(
            [along_all(squares, values).sum(1), Directional(squares, values).by(0), single.flatten()]
        )

    scales = np.linspace(0.5, 2.0, 200)
    with ThreadPoolExecutor(4) as pool:
        found = torch.stack(list(pool.map(all_of_them, scales))).numpy()
    x = scales[:, None] * VALUES.numpy()
    wanted = np.column_stack([2 * x, 2 * x[:, 0], np.zeros((200, 2)), 3 * x[:, 0] ** 2])
    assert found == pytest.approx(wanted, rel=1e-12)
