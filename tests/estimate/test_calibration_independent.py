"""Calibration of frames made by HCIPy (independent code): no model error is shared with the fit."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.optics_cases import PRIOR, READ_NOISE, draw_frames, everything, ncpa_nm, settings
from helpers.reference_psf import reference

from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions
from irlos_pipe.estimate.cube import Frames

HIGHEST_NOLL, FRAMES, FLUX_E = 21, 16, 2e6
TRUE_NM = ncpa_nm(9, HIGHEST_NOLL, 120.0)


def frames_of(case) -> Frames:
    images = draw_frames(reference().spectral_image(TRUE_NM, case) * FLUX_E, FRAMES, seed=12)
    return Frames(images, everything(images), READ_NOISE)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_finds_the_aberrations_of_independent_frames(method):
    case = settings(48)
    result = calibrate(frames_of(case), case, CalibrationOptions(method, highest_noll=HIGHEST_NOLL))
    error = result.zernike_nm - np.array(list(TRUE_NM.values()))
    assert np.linalg.norm(error) < 0.5
    assert set(result.frame_status) == {"converged"}


@pytest.mark.slow
def test_the_mean_of_frames_without_model_error_has_a_chi2_of_one():
    case = settings(48)
    result = calibrate(frames_of(case), case, CalibrationOptions(highest_noll=HIGHEST_NOLL, prior=PRIOR))
    freedom = 48**2 - HIGHEST_NOLL - 1
    assert result.chi2_nu == pytest.approx(1, abs=4 * np.sqrt(2 / freedom))


@pytest.mark.slow
@pytest.mark.parametrize("window", [51, (40, 57)], ids=str)
def test_odd_and_rectangular_windows_in_two_colours_bring_no_bias(window):
    case = settings(window, ((1560.0, 1.0), (1690.0, 2.0)))
    result = calibrate(frames_of(case), case, CalibrationOptions(highest_noll=HIGHEST_NOLL, prior=PRIOR))
    error = result.zernike_nm - np.array(list(TRUE_NM.values()))
    assert np.linalg.norm(error) < 0.4
    assert np.sqrt(np.mean((error / result.sigma_nm) ** 2)) < 1.8


@pytest.mark.slow
def test_the_other_sign_of_the_diversity_is_told_apart():
    """With the wrong sign assumed, the fit must not pass for a good one."""
    case, wrong = settings(48), settings(48, diversity={6: 170.0})
    result = calibrate(frames_of(case), wrong, CalibrationOptions(highest_noll=HIGHEST_NOLL, prior=PRIOR))
    true = np.array(list(TRUE_NM.values()))
    assert np.linalg.norm(result.zernike_nm - true) > 50
