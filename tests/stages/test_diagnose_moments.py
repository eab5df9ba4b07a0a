"""Which recordings are of one star and night, and how results and report say what they share."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.made_run import recording

from irlos_pipe.stages.diagnose.work import moments_of

HOUR_S = 3600.0


def taken(target: str, hours: float):
    one = recording("cube", "cube", 2)
    acquisition = replace(one.acquisition, target=target)
    return replace(one, acquisition=acquisition, start_unix_s=one.start_unix_s + hours * HOUR_S)


@pytest.mark.parametrize(
    ("targets", "hours", "expected"),
    [
        ("AAB", (0, 1, 2), [0, 0, 1]),  # another star
        ("ABA", (0, 1, 2), [0, 1, 0]),  # the first star again, the same night
        ("AAA", (0, 8, 24), [0, 0, 1]),  # another night
        ("AAA", (0, 8, 16), [0, 0, 0]),  # 16 h, but never 12 between two
        ("AA", (0, float("nan")), [0, 0]),  # times not known: the targets tell
    ],
)
def test_stars_and_nights_follow_from_targets_and_times(targets, hours, expected):
    recordings = [taken(target, hour) for target, hour in zip(targets, hours, strict=True)]
    assert moments_of(recordings) == expected
