"""Quoted errors of many frames hold what the model leaves unexplained.

Truth: the covariance of the mean of independent draws, and the scaling of errors by √(χ²/ν).
"""

from types import SimpleNamespace

import numpy as np
import pytest

from irlos_pipe.estimate.calibration_errors import errors_of

SIGMA_NM, FRAMES = 8.0, 400
DRAWN_NM = np.random.default_rng(4).normal(0.0, SIGMA_NM, (FRAMES, 5))


def sigma_nm(misfit: float) -> np.ndarray:
    """Errors of five modes; many frames need neither problem nor solution."""
    covariance, source = errors_of(SimpleNamespace(show_scatter=True), None, None, DRAWN_NM, misfit)
    assert source == "frames"
    return np.sqrt(np.diag(covariance))


def test_the_error_of_a_mean_falls_with_the_root_of_the_frames():
    assert sigma_nm(1.0) == pytest.approx(SIGMA_NM / np.sqrt(FRAMES), rel=0.3)


@pytest.mark.parametrize(("misfit", "growth"), [(0.3, 1.0), (1.0, 1.0), (4.0, 2.0), (252.0, np.sqrt(252))])
def test_errors_grow_with_the_root_of_what_is_above_the_nominal_misfit_and_never_shrink(misfit, growth):
    assert sigma_nm(misfit) == pytest.approx(growth * sigma_nm(1.0))
