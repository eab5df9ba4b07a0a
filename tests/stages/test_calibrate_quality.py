"""Cubes whose numbers contradict what was told of them fail the quality check; roles must fit."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers import made_run

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.calibration_errors import NominalChi2
from irlos_pipe.estimate.cube import Motion
from irlos_pipe.estimate.residual import Lacking, Mirrored
from irlos_pipe.estimate.twin import TwinCheck
from irlos_pipe.stages.calibrate.input import require_calibration
from irlos_pipe.stages.calibrate.quality import Limits, checks_of

GOOD = {
    "frame_status": ["converged"],
    "chi2_nu": 0.40,
    "nominal": NominalChi2(0.37, 0.03),
    "window_resolutions": 15.0,
    "noise_ratio": 9.0,
    "kurtosis": 2.8,
    "errors_from": "frames",
    "frames_nm": [None] * 200,
    "twin": TwinCheck(7.5, 100.0, 330.0, 310.0, 60.0),
    "mirrored": Mirrored(0.05, 0.1),
    "motion": None,
    "mean_image_e": np.zeros((40, 48)),
    "lacking": None,
}


def _failed(limits: Limits | None = None, **changes) -> dict[str, str]:
    result = SimpleNamespace(**GOOD | changes)
    return {one.name: one.message for one in checks_of(limits or Limits(), result) if not one.passed}


@pytest.mark.parametrize("sigma", [0.01, 0.1, 0.2])
def test_images_that_show_the_mirrored_pupil_fail(sigma):
    assert "mirrored" in _failed(mirrored=Mirrored(1.0, sigma))["orientation"]
    assert _failed(mirrored=Mirrored(3 * sigma, sigma)) == {} or sigma < 0.1


def test_a_pupil_that_is_mirrored_or_not_within_the_errors_is_not_judged():
    assert _failed(mirrored=Mirrored(1.0, 0.3)) == {} == _failed(mirrored=None)


def test_a_right_cube_passes():
    assert _failed() == {}


def test_chi2_above_its_nominal_value_names_the_fact_that_explains_it():
    lacks = Lacking(0.68, "pixels of 9.7 mas instead of 9.9 mas")
    message = _failed(chi2_nu=1.2, lacking=lacks)["chi2 of the mean image"]
    assert (
        "pixels of 9.7 mas instead of 9.9 mas would explain 68% of the misfit; irlos run diagnose" in message
    )


@pytest.mark.parametrize("chi2_nu", [0.7, 2.7, 5.1, 252.0])
def test_chi2_above_its_nominal_value_fails(chi2_nu):
    assert "diagnose" in _failed(chi2_nu=chi2_nu)["chi2 of the mean image"]


def test_a_mild_misfit_on_the_bench_fails():
    assert _failed(chi2_nu=1.5, nominal=NominalChi2(1.01, 0.04))
    assert not _failed(chi2_nu=1.1, nominal=NominalChi2(1.01, 0.02))


def test_chi2_below_its_nominal_value_fails():
    assert "share their noise" in _failed(chi2_nu=0.14)["chi2 of the mean image"]


def test_a_limit_of_the_recipe_takes_the_place_of_the_nominal_one():
    assert _failed(Limits(max_chi2_nu=1000.0), chi2_nu=252.0) == {}


def test_noise_told_larger_than_the_frames_show_fails():
    assert "e_per_adu" in _failed(noise_ratio=0.01)["noise as told"]


def test_frames_of_two_stars_fail():
    assert "two kinds" in _failed(kurtosis=1.05)["frames of one kind"]
    assert not _failed(kurtosis=float("nan"))


def test_a_star_that_moves_through_more_than_a_quarter_of_the_window_fails():
    drift_px = np.linspace(-1, 1, 20)[:, None] * [1.0, 0.5]
    assert _failed(motion=Motion(4.9 * drift_px, 0.01)) == {}
    assert "drifts, by 10.2 px" in _failed(motion=Motion(5.1 * drift_px, 0.01))["motion of the star"]


def test_a_small_window_fails():
    assert "outside" in _failed(window_resolutions=5.6)["window"]


def test_two_or_three_frames_behind_an_ao_system_fail():
    assert "too few" in _failed(errors_from="few_frames", frames_nm=[None] * 3)["frames"]
    assert not _failed(errors_from="noise", frames_nm=[None] * 3)


@pytest.mark.parametrize("evidence", [-60.0, 0.0, 3.9])
def test_a_twin_that_is_not_excluded_fails_though_its_rms_is_larger(evidence):
    twin = TwinCheck(0.0, 100.0, 120.0, 200.0, evidence)
    assert "twin solution" in _failed(twin=twin)


def test_a_ramp_is_refused_as_calibration():
    ramp = made_run.recording("offset_00", "calibration", 2)
    ramp.acquisition.__dict__["role"] = "defocus_ramp"
    with pytest.raises(InputDataError, match="role is defocus_ramp"):
        require_calibration([ramp])


def test_frames_of_different_introduced_defocus_are_refused():
    cubes = [made_run.recording(f"cube_{nm:g}", "calibration", 2, nm) for nm in (0.0, 100.0)]
    with pytest.raises(InputDataError, match="introduced_defocus_nm differs"):
        require_calibration(cubes)
    require_calibration(cubes[1:])
