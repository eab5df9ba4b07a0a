"""The suite of plausible but wrong inputs: its cases, and how their outcomes are counted.

Truth: outcomes written down by hand.
"""

import pytest

from benchmarks.misled.cases import CALIBRATION, DIAGNOSIS, HIDDEN, NIGHT, all_cases
from benchmarks.misled.reducing import diagnosis_errors, mode_errors, ramp_errors
from benchmarks.misled.suite import summary, table, verdict

PASSED = {"kind": CALIBRATION, "family": "x", "right": False, "cause": "", "accused": [], "warned": []}
PASSED |= {"sigmas": 1.0, "untested": []}
WRONG = {"sigmas": 9.0}
FOUND = {"steps": [], "mdb": {}, "untestable": [], "grade": "none", "verdict": "none"}
FOUND |= {"zernike_nm": {"after": {"4": 10.0}}, "sigma_nm": {"4": 1.0}}


def test_what_is_wrong_does_not_change_wavefront_and_noise():
    of_one = [c for c in all_cases(1, 1) if (c.kind, c.setting, c.number) == (CALIBRATION, "sky", 0)]
    assert len(of_one) > 40 and len({case.seed for case in of_one}) == 1


@pytest.mark.parametrize(
    ("change", "column"),
    [
        ({}, "passed"),
        (WRONG, "misled"),
        ({"accused": ["slope"]} | WRONG, "accused"),
        ({"warned": ["spectrum taken from the profile"]} | WRONG, "misled"),
        ({"warned": ["exposure_s is odd"]} | WRONG, "warned only"),
        ({"cause": "transposed", "untested": ["images transposed"]} | WRONG, "said before"),
        ({"cause": "transposed"} | WRONG, "misled"),
        ({"kind": NIGHT, "accused": ["night"]} | WRONG, "misled"),
        ({"kind": NIGHT, "accused": ["night"]}, "accused"),
        ({"kind": DIAGNOSIS, "finding": "named"}, "accused"),
        ({"kind": DIAGNOSIS, "finding": "misnamed"}, "misled"),
        ({"kind": DIAGNOSIS, "finding": "misnamed", "right": True}, "accused"),
        ({"kind": DIAGNOSIS, "finding": "none"}, "misled"),
        ({"kind": DIAGNOSIS, "finding": "none", "right": True}, "passed"),
        ({"kind": DIAGNOSIS, "finding": "too small"}, "passed"),
    ],
)
def test_an_outcome_is_counted_once_as_what_a_user_is_told(change, column):
    assert verdict(PASSED | change) == column


def test_an_error_counts_in_quoted_ones_of_the_worst_mode_beyond_tilt():
    errors = mode_errors({"2": 99.0, "4": 3.0, "5": -1.0}, {"2": 1.0, "4": 2.0, "5": 0.5}, {5: 1.0})
    assert errors["sigmas"] == 4.0


def test_a_ramp_counts_by_the_rms_of_its_frames_whatever_their_order():
    points = [{"name": name, "defocus_nm": nm, "sigma_nm": 2.0} for name, nm in (("b", 14.0), ("a", -4.0))]
    ramp = {"points": points, "chi2_nu": 1.0, "nominal_chi2_nu": 0.5, "summary": {"slope": 1.0}}
    assert ramp_errors(ramp, {"a": 0.0, "b": 10.0})["sigmas"] == 2.0


@pytest.mark.parametrize(("stated", "finding"), [(0.1, "too small"), (0.01, "none")])
def test_nothing_found_is_right_where_less_is_hidden_than_can_be_detected(stated, finding):
    hidden = HIDDEN["companion 5 %"]
    case = next(one for one in all_cases(1, 1) if one.kind == DIAGNOSIS and one.taken.hidden == hidden)
    results = FOUND | {"mdb": {"companion": {"flux_ratio": stated}}}
    assert diagnosis_errors(case, results, {4: 10.0})["finding"] == finding


def test_the_table_has_a_row_per_family_and_the_summary_every_outcome():
    outcomes = [PASSED, PASSED | {"accused": ["slope"]}, PASSED | {"family": "right: y", "right": True}]
    assert "| calibration | x | 2 | 1 | 0 | 0 | 1 | 0 |" in table(outcomes)
    assert "| calibration | right | 1 | 0 | 0 | 0 | 1 | 0 |" in table(outcomes)
    assert "2 wrong inputs: 1 accused" in summary(outcomes)
    assert "1 right inputs: 0 accused" in summary(outcomes)
