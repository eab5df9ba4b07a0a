"""Which recordings belong together, on descriptions made by hand."""

from dataclasses import replace
from pathlib import Path

import pytest

from irlos_pipe.night.description import Description, night_of
from irlos_pipe.night.grouping import cube_key, group_recordings
from irlos_pipe.night.settings import NightSettings

LENS, MIRROR = "9.7 mas per pixel, lens, Noll 6 -170 nm", "9.7 mas per pixel, mirror, Noll 6 -170 nm"
EVENING_S = 1707609600.0  # 2024-02-11 00:00 UTC
NIGHT = "2024-02-10"
SETTINGS = NightSettings()


def recording(name: str, role: str, minute: float | None = 0.0, folder: str = "night", **more) -> Description:
    start = None if minute is None else EVENING_S + 60 * minute
    known = Description(Path("/data", folder, name), name, role, NIGHT, start, window=(64, 64))
    return replace(known, **({"configuration": LENS} | more))


def cube(name: str, minute: float | None = 0.0, **changes) -> Description:
    return recording(name, "ncpa_calibration", minute, **changes)


def offset(name: str, minute: float | None, folder: str = "ramp", **changes) -> Description:
    return recording(name, "defocus_ramp", minute, folder, **changes)


def calibrations_used(*found: Description) -> dict[str, str]:
    """Name of the calibration by that of the ramp's first recording."""
    groups = [one for one in group_recordings(found, SETTINGS).groups if one.kind == "ramp"]
    return {one.inputs["ramp"][0].name: one.inputs["calibration"][0].name for one in groups}


def names(found) -> list[tuple[str, list[str]]]:
    return [(one.kind, [member.name for member in next(iter(one.inputs.values()))]) for one in found.groups]


def test_every_calibration_cube_is_a_group_that_recipes_may_call_by_either_name():
    found = group_recordings([cube("b", 5), cube("a", 9)], SETTINGS)
    assert names(found) == [("calibration", ["b"]), ("calibration", ["a"])]
    assert all(one.inputs["calibration"] == one.inputs["cube"] for one in found.groups)


def test_offsets_of_one_folder_that_follow_one_another_are_one_ramp_in_order_of_time():
    found = group_recordings([cube("c"), offset("o2", 12), offset("o0", 10), offset("o1", 11)], SETTINGS)
    assert names(found)[1] == ("ramp", ["o0", "o1", "o2"])


@pytest.mark.parametrize("changes", [{"target": "other"}, {"spectrum": "1600 nm (1)"}, {"folder": "ramp2"}])
def test_another_star_band_or_folder_is_another_ramp(changes):
    found = group_recordings([cube("c"), offset("o0", 10), offset("o1", 11, **changes)], SETTINGS)
    assert names(found)[1:] == [("ramp", ["o0"]), ("ramp", ["o1"])]


def test_a_pause_longer_than_the_gap_ends_a_ramp():
    offsets = [offset("o0", 10), offset("o1", 39), offset("o2", 70)]
    assert names(group_recordings([cube("c"), *offsets], SETTINGS))[1:] == [
        ("ramp", ["o0", "o1"]),
        ("ramp", ["o2"]),
    ]
    longer = group_recordings([cube("c"), *offsets], NightSettings(series_gap_min=60))
    assert names(longer)[1:] == [("ramp", ["o0", "o1", "o2"])]


def test_a_ramp_uses_the_calibration_of_its_configuration_nearest_in_time():
    cubes = [cube("early", 0), cube("near", 30), cube("nearer-but-mirror", 39, configuration=MIRROR)]
    assert calibrations_used(*cubes, offset("o", 40)) == {"o": "near"}
    assert calibrations_used(*cubes, offset("o", 14)) == {"o": "early"}
    assert calibrations_used(*cubes, offset("o", 0, configuration=MIRROR)) == {"o": "nearer-but-mirror"}


def test_several_ramps_may_use_one_calibration():
    found = calibrations_used(cube("c", 0), offset("o", 10), offset("p", 10, "other"))
    assert found == {"o": "c", "p": "c"}


def test_without_times_the_folders_decide():
    cubes = [cube("a", None, folder="first"), cube("b", None, folder="second")]
    assert calibrations_used(*cubes, offset("o", None, "second")) == {"o": "b"}


def test_a_ramp_without_calibration_of_its_configuration_is_left_out_and_that_is_alarming():
    found = group_recordings([cube("c", configuration=MIRROR), offset("o", 5)], SETTINGS)
    assert [(one.recording.name, one.alarming) for one in found.left_out] == [("o", True)]
    assert LENS in found.left_out[0].reason


def test_the_same_night_is_preferred_to_an_earlier_one_and_that_to_a_later_one():
    same = cube("same", 300)
    before, after = cube("before", -1440, night="2024-02-09"), cube("after", 1440, night="2024-02-11")
    ramp = offset("o", 0)
    assert calibrations_used(same, before, after, ramp) == {"o": "same"}
    assert calibrations_used(before, after, ramp) == {"o": "before"}
    assert calibrations_used(after, ramp) == {"o": "after"}


def test_a_calibration_is_used_for_a_number_of_nights_and_may_be_known_from_earlier():
    old = cube("old", -1440 * 7, night="2024-02-03")
    found = group_recordings([offset("o", 0)], SETTINGS, others=[old])
    assert names(found) == [("ramp", ["o"])] and found.groups[0].inputs["calibration"] == (old,)
    assert group_recordings([offset("o", 0)], NightSettings(calibration_nights=6), others=[old]).groups == []


def test_recordings_of_one_ramp_are_of_one_night():
    later = offset("p", 10, night="2024-02-11")
    found = group_recordings([cube("c"), offset("o", 5), later], SETTINGS)
    assert names(found)[1:] == [("ramp", ["o"]), ("ramp", ["p"])]


def test_derotator_cubes_form_one_series_and_psf_recordings_are_separate():
    angles = [recording(f"angle_{i}", "derotator", 3.0 * i) for i in range(3)]
    found = group_recordings([*angles, recording("star", "psf", 50), recording("star2", "psf", 51)], SETTINGS)
    series = ("derotator", ["angle_0", "angle_1", "angle_2"])
    assert names(found) == [series, ("psf", ["star"]), ("psf", ["star2"])]


def test_darks_are_added_to_every_recording_of_their_mode_and_window():
    darks = [
        recording("dark", "dark", 90, configuration="9.7 mas per pixel"),
        recording("small", "dark", 91, window=(32, 32)),
        recording("other", "dark", 92, mode="slow"),
    ]
    found = group_recordings([cube("c"), offset("o", 5), *darks], SETTINGS)
    for group in found.groups:
        for members in group.inputs.values():
            assert [one.name for one in members][-1] == "dark" and len(members) == 2
    assert not found.left_out


def test_recordings_of_2x2_modes_are_groups_of_their_own_kind_and_calibrate_no_ramp():
    four = recording("four", "psf", 3, full_pupil=False)
    found = group_recordings([four, cube("c", full_pupil=False), offset("o", 5)], SETTINGS)
    assert names(found) == [("two_by_two", ["four"])]
    assert [(one.recording.name, one.alarming) for one in found.left_out] == [("c", False), ("o", True)]


def test_groups_are_named_by_time_and_name_and_keep_the_name_when_they_grow():
    first, later = offset("offset_00", 10), offset("offset_01", 11)
    grown = group_recordings([cube("sky cal"), first, later], SETTINGS)
    assert [one.name for one in grown.groups] == ["000000_sky_cal", "001000_ramp"]
    longer = group_recordings([cube("sky cal"), first, later, offset("offset_02", 12)], SETTINGS)
    assert [one.name for one in longer.groups] == ["000000_sky_cal", "001000_ramp"]


def test_groups_that_would_share_a_folder_are_numbered():
    timed = [cube("c", folder="a"), cube("c", folder="b")]
    found = group_recordings([*timed, cube("c", None), cube("../..", None)], SETTINGS)
    assert [one.name for one in found.groups] == ["recording", "c", "000000_c", "000000_c-2"]


@pytest.mark.parametrize(("utc_h", "day"), [(0.0, 10), (16.6, 10), (16.8, 11)])
def test_a_night_ends_at_noon_of_paranal(utc_h, day):
    assert night_of(EVENING_S + 3600 * utc_h) == f"2024-02-{day}"


def test_a_calibration_that_failed_serves_no_ramp_and_the_choice_says_why():
    good, companion = cube("cal_good", 0), cube("cal_companion", 50)
    failed = {cube_key(companion): "failed calibrate: chi2 of the mean image"}
    (ramp,) = (
        one
        for one in group_recordings([good, companion, offset("o", 60)], SETTINGS, (), failed).groups
        if one.kind == "ramp"
    )
    assert ramp.inputs["calibration"][0].name == "cal_good"
    assert "cal_good, 60 min away" in ramp.choice
    assert "not cal_companion: failed calibrate: chi2 of the mean image" in ramp.choice


def test_a_ramp_without_a_calibration_that_passed_is_left_out_loudly():
    only = cube("cal_companion", 50)
    found = group_recordings(
        [only, offset("o", 60)], SETTINGS, (), {cube_key(only): "failed calibrate: chi2"}
    )
    (left,) = found.left_out
    assert left.alarming and "cal_companion: failed calibrate: chi2" in left.reason
