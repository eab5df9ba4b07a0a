"""Curves of a diagnosis, from pictures whose residual is drawn noise; truth: what was drawn."""

import numpy as np
import pytest
from helpers.made_run import star
from helpers.optics_cases import settings

from irlos_pipe.diagnosis.verdict import Pictures
from irlos_pipe.stages.diagnose.output import quality_arrays


def pictures() -> Pictures:
    after, sigma = star(3.0), np.full(star().shape, 2.0)
    measured = after + sigma * np.random.default_rng(2).standard_normal(after.shape)
    sigma[4, 5], measured[4, 5] = np.inf, 1e9  # a bad pixel
    nothing = np.zeros((2, 2))
    return Pictures(measured, sigma, 0.9 * after, after, nothing, nothing, nothing)


def test_what_a_right_model_leaves_is_white_and_what_a_wrong_one_leaves_is_not():
    made = pictures()
    found = quality_arrays(made, settings(made.after_e.shape))
    arrays = {name: one.value for name, one in found.items()}
    assert arrays["left_power_after"].mean() == pytest.approx(1.0, abs=0.25)
    assert arrays["left_power_before"][0] > 10
