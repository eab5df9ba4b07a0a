"""What a diagnosis cannot explain fails the quality check."""

import pytest

from irlos_pipe.stages.diagnose.quality import checks_of
from irlos_pipe.stages.diagnose.results import DiagnoseResults


def test_frames_of_two_kinds_need_a_look_whatever_the_verdict():
    results = DiagnoseResults(verdict="none", grade="none")
    checks = {one.name: one.passed for one in checks_of(results, [1.05])}
    assert checks == {"everything explained": True, "frames of one kind": False}
    assert len(checks_of(results, [float("nan")])) == 1 and all(
        one.passed for one in checks_of(results, [2.9])
    )


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
