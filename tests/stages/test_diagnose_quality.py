"""What a diagnosis cannot explain fails the quality check."""

import pytest

from irlos_pipe.stages.diagnose.output import checks_of
from irlos_pipe.stages.diagnose.results import DiagnoseResults


@pytest.mark.parametrize(
    ("verdict", "grade", "unexplained", "passed"),
    [
        ("none", "none", False, True),
        ("effect", "complete", False, True),
        ("effect", "partial", True, False),
        ("unknown", "resembles", True, False),
        ("unknown", "unknown", True, False),
        ("unknown", "", False, False),  # of a ramp, which has no grade
    ],
)
def test_only_a_diagnosis_that_leaves_nothing_passes(verdict, grade, unexplained, passed):
    results = DiagnoseResults(verdict=verdict, grade=grade, unexplained=unexplained, sentence="What is left.")
    (check,) = checks_of(results)
    assert check.passed is passed
    assert check.message.endswith("What is left.") and verdict in check.message
