"""Which recordings belong together, on descriptions made by hand."""

from dataclasses import replace
from pathlib import Path

import pytest

from irlos_pipe.night.grouping import cube_key, group_recordings
from irlos_pipe.night.recordings import Description, night_of
from irlos_pipe.night.settings import NightSettings

LENS, MIRROR = "9.7 mas per pixel, lens, Noll 6 -170 nm", "9.7 mas per pixel, mirror, Noll 6 -170 nm"
EVENING_S = 1707609600.0  # 2024-02-11 00:00 UTC
SETTINGS = NightSettings()


def recording(name: str, role: str, minute: float | None = 0.0, folder: str = "night", **more) -> Description:
    start = None if minute is None else EVENING_S + 60 * minute
    known = Description(Path("/data", folder, name), name, role, "2024-02-10", start, window=(64, 64))
    return replace(known, **({"configuration": LENS} | more))


def cube(name: str, minute: float | None = 0.0, **changes) -> Description:
    return recording(name, "ncpa_calibration", minute, **changes)


def offset(name: str, minute: float | None, folder: str = "ramp", **changes) -> Description:
    return recording(name, "defocus_ramp", minute, folder, **changes)


def calibrations_used(*found: Description) -> dict[str, str]:
    """Name of the calibration by that of the ramp's first recording."""
    groups = [one for one in group_recordings(found, SETTINGS)[0] if one.kind == "ramp"]
    return {one.inputs["ramp"][0].name: one.inputs["calibration"][0].name for one in groups}


def names(found, settings=SETTINGS) -> list[tuple[str, list[str]]]:
    groups, _ = group_recordings(found, settings)
    return [(one.kind, [member.name for member in next(iter(one.inputs.values()))]) for one in groups]


def test_every_calibration_cube_is_a_group_that_recipes_may_call_by_either_name():
    cubes = [cube("b", 5), cube("a", 9)]
    assert names(cubes) == [("calibration", ["b"]), ("calibration", ["a"])]
    assert all(
        one.inputs["calibration"] == one.inputs["cube"] for one in group_recordings(cubes, SETTINGS)[0]
    )


def test_offsets_of_one_folder_that_follow_one_another_are_one_ramp_in_order_of_time():
    found = names([cube("c"), offset("o2", 12), offset("o0", 10), offset("o1", 11)])
    assert found[1] == ("ramp", ["o0", "o1", "o2"])


@pytest.mark.parametrize(
    "changes",
    [{"target": "other"}, {"spectrum": "1600 nm (1)"}, {"folder": "ramp2"}, {"night": "2024-02-11"}],
)
def test_another_star_band_folder_or_night_is_another_ramp(changes):
    found = names([cube("c"), offset("o0", 10), offset("o1", 11, **changes)])
    assert found[1:] == [("ramp", ["o0"]), ("ramp", ["o1"])]


def test_a_pause_longer_than_the_gap_ends_a_ramp():
    found = [cube("c"), offset("o0", 10), offset("o1", 39), offset("o2", 70)]
    assert names(found)[1:] == [("ramp", ["o0", "o1"]), ("ramp", ["o2"])]
    assert names(found, NightSettings(series_gap_min=60))[1:] == [("ramp", ["o0", "o1", "o2"])]


def test_ramps_use_the_calibration_of_their_configuration_nearest_in_time():
    cubes = [cube("early", 0), cube("near", 30), cube("nearer-but-mirror", 39, configuration=MIRROR)]
    assert calibrations_used(*cubes, offset("o", 40), offset("p", 40, "other")) == {"o": "near", "p": "near"}
    assert calibrations_used(*cubes, offset("o", 14)) == {"o": "early"}
    assert calibrations_used(*cubes, offset("o", 0, configuration=MIRROR)) == {"o": "nearer-but-mirror"}


def test_of_one_night_the_calibration_in_the_band_of_the_ramp_comes_first():
    cubes = [cube("H", 0, spectrum="1600 nm (1)"), cube("J", 30, spectrum="1250 nm (1)")]
    assert calibrations_used(*cubes, offset("o", 40, spectrum="1600 nm (1)")) == {"o": "H"}
    assert calibrations_used(*cubes, offset("o", 40, spectrum="1600 nm (1), 1250 nm (1)")) == {"o": "J"}


def test_without_times_the_folders_decide():
    cubes = [cube("a", None, folder="first"), cube("b", None, folder="second")]
    assert calibrations_used(*cubes, offset("o", None, "second")) == {"o": "b"}


def test_a_ramp_without_calibration_of_its_configuration_is_left_out_and_that_is_alarming():
    (left,) = group_recordings([cube("c", configuration=MIRROR), offset("o", 5)], SETTINGS)[1]
    assert left.recording.name == "o" and left.alarming and LENS in left.reason


def test_the_same_night_is_preferred_to_an_earlier_one_and_that_to_a_later_one():
    same = cube("same", 300)
    before, after = cube("before", -1440, night="2024-02-09"), cube("after", 1440, night="2024-02-11")
    ramp = offset("o", 0)
    assert calibrations_used(same, before, after, ramp) == {"o": "same"}
    assert calibrations_used(before, after, ramp) == {"o": "before"}
    assert calibrations_used(after, ramp) == {"o": "after"}


def test_a_calibration_is_used_for_a_number_of_nights_and_may_be_known_from_earlier():
    old = cube("old", -1440 * 7, night="2024-02-03")
    ((ramp,), _) = group_recordings([offset("o", 0)], SETTINGS, others=[old])
    assert ramp.kind == "ramp" and ramp.inputs["calibration"] == (old,)
    assert group_recordings([offset("o", 0)], NightSettings(calibration_nights=6), others=[old])[0] == []


def test_derotator_cubes_form_one_series_and_psf_recordings_are_separate():
    angles = [recording(f"angle_{i}", "derotator", 3.0 * i) for i in range(3)]
    found = names([*angles, recording("star", "psf", 50), recording("star2", "psf", 51)])
    series = ("derotator", ["angle_0", "angle_1", "angle_2"])
    assert found == [series, ("psf", ["star"]), ("psf", ["star2"])]


def test_darks_are_added_to_every_recording_of_their_mode_and_window():
    darks = [
        recording("dark", "dark", 90, configuration="9.7 mas per pixel"),
        recording("small", "dark", 91, window=(32, 32)),
        recording("other", "dark", 92, mode="slow"),
    ]
    groups, left_out = group_recordings([cube("c"), offset("o", 5), *darks], SETTINGS)
    for members in (one for group in groups for one in group.inputs.values()):
        assert [one.name for one in members][-1] == "dark" and len(members) == 2
    assert not left_out


def test_recordings_of_2x2_modes_are_groups_of_their_own_kind_and_calibrate_no_ramp():
    found = [recording("four", "psf", 3, full_pupil=False), cube("c", full_pupil=False), offset("o", 5)]
    assert names(found) == [("two_by_two", ["four"])]
    left_out = group_recordings(found, SETTINGS)[1]
    assert [(one.recording.name, one.alarming) for one in left_out] == [("c", False), ("o", True)]


def test_groups_are_named_by_time_and_name_keep_it_when_they_grow_and_are_numbered_where_it_is_taken():
    some = [cube("sky cal"), offset("offset_00", 10), offset("offset_01", 11)]
    for found in (some, [*some, offset("offset_02", 12)]):
        assert [one.name for one in group_recordings(found, SETTINGS)[0]] == ["000000_sky_cal", "001000_ramp"]
    alike = [cube("c", folder="a"), cube("c", folder="b"), cube("c", None), cube("../..", None)]
    found = [one.name for one in group_recordings(alike, SETTINGS)[0]]
    assert found == ["recording", "c", "000000_c", "000000_c-2"]


@pytest.mark.parametrize("longitude_deg", [-155.5, -70.4, 0.0, 149.1])
def test_a_night_ends_at_noon_of_its_site(longitude_deg):
    """The mean sun culminates at longitude 0 at 12 h UTC, and 4 minutes earlier per degree to the east."""
    noon_s = 1707523200 + 3600 * (12 - longitude_deg / 15)  # of 2024-02-10
    before, after = night_of(noon_s - 60, longitude_deg), night_of(noon_s + 60, longitude_deg)
    assert (before, after) == ("2024-02-09", "2024-02-10")


def test_a_calibration_that_failed_serves_no_ramp_and_the_choice_says_why():
    good, poor, ramp = cube("cal_good", 0), cube("cal_companion", 50), offset("o", 60)
    failed = {cube_key(poor): "failed calibrate: chi2 of the mean image"}
    groups, _ = group_recordings([good, poor, ramp], SETTINGS, (), failed)
    (choice,) = (one.choice for one in groups if one.kind == "ramp")
    assert choice.startswith("cal_good, 60 min away")
    assert "not cal_companion: failed calibrate: chi2 of the mean image" in choice
    (left,) = group_recordings([poor, ramp], SETTINGS, (), failed)[1]
    assert left.alarming and "cal_companion: failed calibrate: chi2" in left.reason
