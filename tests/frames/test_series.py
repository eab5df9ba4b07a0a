"""Numbers of every frame. Truth: closed forms of a Gaussian star on a level."""

import numpy as np
import pytest

from irlos_pipe.frames.recording import frame_series


@pytest.mark.parametrize("width_px", [1.8, 3.5])
def test_a_gaussian_star_has_its_width_place_light_and_level(width_px):
    y, x = np.indices((33, 41))
    places = [(16.0, 20.0), (14.3, 22.6)]
    stars = [np.exp(-((y - row) ** 2 + (x - column) ** 2) / (2 * width_px**2)) for row, column in places]
    images, good = 5000 * np.array(stars) + 7.0, np.ones((33, 41), bool)
    images[:, 3, 4], good[3, 4] = 1e6, False  # a hot pixel
    found = frame_series(images, good)
    assert found["fwhm_px"] == pytest.approx(2 * np.sqrt(2 * np.log(2)) * width_px, rel=0.05)
    assert found["x_px"] == pytest.approx([0, 2.6], abs=0.08)
    assert found["y_px"] == pytest.approx([0, -1.7], abs=0.08)
    assert found["level_e"] == pytest.approx(7.0, abs=0.1)
    assert found["peak_e"][0] == pytest.approx(5000, rel=0.01)
    assert found["flux_e"] == pytest.approx(images.sum(axis=(1, 2)))
