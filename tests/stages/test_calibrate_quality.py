"""Cubes whose numbers contradict what was told of them fail the quality check; roles must fit."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers import made_run

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.calibration_errors import NominalChi2
from irlos_pipe.estimate.cube import Motion
from irlos_pipe.estimate.residual import Mirrored
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
    "effects": {"seeing_halo": {}},
}


def _failed(limits: Limits | None = None, **changes) -> dict[str, str]:
    result = SimpleNamespace(**GOOD | changes)
    return {one.name: one.message for one in checks_of(limits or Limits(), result) if not one.passed}


def moved(most_px: float) -> Motion:
    return Motion(most_px * np.linspace(-1, 1, 20)[:, None] * [1.0, 0.5], 0.01)


CHI2, TWIN = "chi2 of the mean image", "twin solution"
BENCH = {"nominal": NominalChi2(1.01, 0.04)}


@pytest.mark.parametrize(
    ("changes", "check", "said"),
    [
        *(({"mirrored": Mirrored(1.0, sigma)}, "orientation", "mirrored") for sigma in (0.01, 0.1, 0.2)),
        *(({"chi2_nu": chi2_nu}, CHI2, "nominal") for chi2_nu in (0.7, 2.7, 252.0)),
        ({"chi2_nu": 1.5} | BENCH, CHI2, "nominal"),
        ({"chi2_nu": 0.14}, CHI2, "share their noise"),
        ({"noise_ratio": 0.01}, "noise as told", "e_per_adu"),
        ({"kurtosis": 1.05}, "frames of one kind", "two kinds"),
        ({"motion": moved(5.1)}, "motion of the star", "drifts, by 10.2 px"),
        ({"window_resolutions": 5.6}, "window", "outside"),
        ({"errors_from": "few_frames", "frames_nm": [None] * 3}, "frames", "too few"),
        ({"errors_from": "noise", "frames_nm": [None]}, "frames", "too few"),
        # though the RMS of the twin is larger
        *(({"twin": TwinCheck(0, 100, 120, 200, one)}, TWIN, "sign") for one in (-60.0, 0.0, 3.9)),
    ],
)
def test_a_cube_that_contradicts_what_was_told_fails_and_says_why(changes, check, said):
    assert said in _failed(**changes)[check]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mirrored": Mirrored(0.3, 0.1)},
        {"mirrored": Mirrored(1.0, 0.3)},  # mirrored or not within the errors
        {"mirrored": None},
        {"chi2_nu": 1.1, "nominal": NominalChi2(1.01, 0.02)},
        {"chi2_nu": 252.0, "limits": Limits(max_chi2_nu=1000.0)},  # a limit of the recipe
        {"kurtosis": float("nan")},
        {"motion": moved(4.9)},
        {"errors_from": "noise", "frames_nm": [None] * 3},
        {
            "errors_from": "noise",
            "frames_nm": [None],
            "effects": {},
        },  # nothing moves: one says as much as three
    ],
)
def test_a_cube_within_its_errors_passes(changes):
    assert _failed(**changes) == {}


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
