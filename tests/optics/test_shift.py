"""Band-limited shifts. Truth: functions known in closed form whose spectrum ends where it is said to."""

import numpy as np
import pytest
import torch

from irlos_pipe.optics.focus_table import ShiftMatrices

BAND, BEYOND = 0.32, 16
LIKE = torch.empty(0, dtype=torch.float64)


def profile(x: np.ndarray) -> np.ndarray:
    """``sinc⁴``, whose spectrum is a convolution of four boxes and ends at `BAND` exactly."""
    return np.sinc(BAND / 2 * x) ** 4


def slope(x: np.ndarray) -> np.ndarray:
    """Its derivative, by central differences in steps far below a pixel."""
    return (profile(x + 1e-5) - profile(x - 1e-5)) / 2e-5


def along(pixels: int, centre: float) -> np.ndarray:
    """Distances of the pixels of a window from `centre`, which counts from the window's middle."""
    return np.arange(pixels) - (pixels - 1) / 2 - centre


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.45), (-3.7, 5.2), (6.9, -6.9)])
@pytest.mark.parametrize("window", [(24, 24), (20, 33)])
def test_an_image_and_its_slopes_are_moved_to_where_they_belong(window, shift):
    rows, columns = window
    wide = np.outer(profile(along(rows + 2 * BEYOND, 0.4)), profile(along(columns + 2 * BEYOND, -1.3)))
    matrices = ShiftMatrices(window, BEYOND, BAND, 1.0, LIKE)
    along_y, along_x = (m[0].numpy() for m in matrices(torch.tensor([shift], dtype=torch.float64)))
    moved = along_y @ wide[::-1, ::-1] @ along_x.T
    y, x = along(rows, 0.4 + shift[1]), along(columns, -1.3 + shift[0])
    truth = np.outer(profile(y), profile(x))
    assert np.abs(moved[:rows, :columns] - truth).max() < 1e-5
    assert np.abs(moved[rows:, :columns] + np.outer(slope(y), profile(x))).max() < 1e-5
    assert np.abs(moved[:rows, columns:] + np.outer(profile(y), slope(x))).max() < 1e-5
