"""Which recordings are of one star and night, and how results and report say what they share."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.made_run import recording

from irlos_pipe.report.section_diagnose import sharing_tables
from irlos_pipe.stages.diagnose.results import DiagnoseResults, OwnValueRow, SharingRow, StarRow
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


@pytest.mark.parametrize(("apart", "expected"), [(True, [0, 1]), (False, [0, 0])])
def test_the_recipe_may_say_which_are_of_one_star_and_night(apart, expected):
    assert moments_of([taken("A", 0), taken("A", 1)], apart) == expected


def test_the_report_shows_findings_values_and_changes():
    values = [
        OwnValueRow(
            recording=f"night {n}", parameters={"fraction": 0.01}, sigma={"fraction": 1e-4}, significance=90
        )
        for n in (1, 2)
    ]
    row = SharingRow(
        effect="plate_scale",
        finding="common",
        significance=0.4,
        chi2_fall=0.9,
        parameters=1,
        held_out_z=-0.5,
        values=values,
    )
    stars = [StarRow(name=f"night {n}", star="A", ncpa_change_nm=7.1, sigma_nm=0.5) for n in (1, 2)]
    evidence, of_each, wavefronts = sharing_tables(DiagnoseResults(sharing=[row], recordings=stars))
    assert evidence.rows == [("plate_scale", "common to all", "0.4 σ", "1 (1)", "-0.5")]
    assert [one[:3] for one in of_each.rows] == [
        ("plate_scale", "night 1", "fraction"),
        ("plate_scale", "night 2", "fraction"),
    ]
    assert wavefronts.rows[0][:2] == ("night 1", "A")
    assert sharing_tables(DiagnoseResults()) == []
