"""The suite of plausible but wrong inputs: its cases, and how their outcomes are counted.

Truth: outcomes written down by hand.
"""

import pytest

from benchmarks.misled.cases import CALIBRATION, DIAGNOSIS, NIGHT
from benchmarks.misled.suite import verdict

PASSED = {"kind": CALIBRATION, "family": "x", "right": False, "cause": "", "accused": [], "warned": []}
PASSED |= {"sigmas": 1.0, "untested": []}
WRONG = {"sigmas": 9.0}
FOUND = {"steps": [], "mdb": {}, "untestable": [], "grade": "none", "verdict": "none"}
FOUND |= {"zernike_nm": {"after": {"4": 10.0}}, "sigma_nm": {"4": 1.0}}


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
