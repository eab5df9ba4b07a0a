"""The recordings of a series: order, travel of the focus stage, angles, seeds. Expectations are by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.simulation_specs import CUBE, RAMP, planned

from irlos_pipe.simulate.recordings.series import visiting_order

FIVE = [-200, -100, 0, 100, 200]


def reached_nm(folder: Path, effects: dict, **ramp) -> list[float]:
    """Defocus that a ramp of five offsets reaches, in the order of the offsets."""
    recordings = {"ramp": RAMP | {"offsets_nm": FIVE, "effects": effects} | ramp}
    return [one.scene.introduced_nm for one in planned(folder, recordings).values()]


def test_a_ping_pong_ramp_goes_inwards_from_side_to_side():
    assert [FIVE[index] for index in visiting_order(FIVE, "ping_pong")] == [-200, 200, -100, 100, 0]
    shuffled = [100, -200, 0, 200, -100]
    assert [shuffled[index] for index in visiting_order(shuffled, "ping_pong")] == [-200, 200, -100, 100, 0]
    assert visiting_order(FIVE, "as_given") == [0, 1, 2, 3, 4]
    assert visiting_order([5, 6, 7, 8], "ping_pong") == [0, 3, 1, 2]


def test_a_ramp_makes_one_recording_per_offset_and_its_times_tell_the_order(tmp_path):
    ramp = planned(tmp_path, {"ramp": RAMP | {"offsets_nm": FIVE, "order": "ping_pong"}})
    assert list(ramp) == [f"ramp/offset_0{index}" for index in range(5)]
    assert [one.commanded_nm for one in ramp.values()] == FIVE
    by_time = sorted(ramp.values(), key=lambda one: one.scene.start_unix_s)
    assert [one.commanded_nm for one in by_time] == [-200, 200, -100, 100, 0]
    starts = np.array([one.scene.start_unix_s for one in by_time])
    counters = np.array([one.scene.first_counter for one in by_time])
    assert np.all(np.diff(starts) >= 2) and np.array_equal(np.diff(counters), np.diff(starts) * 200)


def test_hysteresis_biases_each_offset_by_the_direction_it_was_reached_from(tmp_path):
    hysteresis = {"focus_stage_hysteresis": {"nm": 20}}
    # From rest at 0: -200 (down), 200 (up), -100 (down), 100 (up), 0 (down).
    assert reached_nm(tmp_path, hysteresis, order="ping_pong") == [-220, -120, -20, 120, 220]
    assert reached_nm(tmp_path, hysteresis) == [-220, -80, 20, 120, 220]


def test_scale_and_partial_offset_of_the_stage_add_up(tmp_path):
    effects = {"focus_stage_scale": {"fraction": 0.1}, "focus_stage_offset": {"nm": 50, "above_nm": 0}}
    assert reached_nm(tmp_path, effects) == pytest.approx([-220, -110, 0, 160, 270])


def test_the_drawn_part_of_the_hysteresis_has_its_rms_and_follows_the_seed(tmp_path):
    effects = {"focus_stage_hysteresis": {"nm": 0, "scatter_nm": 10}}
    offsets = np.linspace(-300, 300, 400).tolist()
    drawn = np.array(reached_nm(tmp_path, effects, offsets_nm=offsets)) - offsets
    assert drawn.std() == pytest.approx(10, rel=0.15) and abs(drawn.mean()) < 2
    assert reached_nm(tmp_path, effects) == reached_nm(tmp_path, effects)


def test_a_stage_that_moves_between_frames_is_told_frame_by_frame(tmp_path):
    cube = CUBE | {"introduced_nm": [0, 50, 0], "effects": {"focus_stage_hysteresis": {"nm": 5}}}
    one = planned(tmp_path, {"steps": cube})["steps"]
    assert one.commanded_nm == (0, 50, 0) and one.scene.introduced_nm == (0, 55, -5)


def test_effects_of_the_stage_are_told_as_hidden_and_act_once(tmp_path):
    effects = {"focus_stage_offset": {"nm": 30}, "plate_scale": {"fraction": 0.01}}
    one = planned(tmp_path, {"ramp": RAMP | {"effects": effects}})["ramp/offset_01"]
    assert one.hidden == effects and one.scene.introduced_nm == 30
    assert one.scene.effects == {"plate_scale": {"fraction": 0.01}}


def test_a_derotator_series_has_one_recording_per_angle(tmp_path):
    series = {"turns": CUBE | {"role": "derotator", "angles_deg": [0, 23, 180]}}
    turns = planned(tmp_path, series, ncpa={"zernike_nm": {5: 10}}, rotating={"zernike_nm": {6: 20}})
    assert [(name, one.scene.derotator_angle_deg) for name, one in turns.items()] == [
        ("turns/angle_00", 0), ("turns/angle_01", 23), ("turns/angle_02", 180)]  # fmt: skip
    assert all(one.scene.rotating_nm == {6: 20} and one.scene.ncpa_nm == {5: 10} for one in turns.values())


def test_recordings_share_the_ncpas_and_nothing_else_that_is_random(tmp_path):
    recordings = {"a": CUBE, "ramp": RAMP, "b": CUBE}
    scenes = [one.scene for one in planned(tmp_path, recordings, ncpa={"total_nm": 142}).values()]
    assert all(scene.ncpa_nm == scenes[0].ncpa_nm for scene in scenes)
    assert np.linalg.norm(list(scenes[0].ncpa_nm.values())) == pytest.approx(142)
    assert sorted(scenes[0].ncpa_nm) == list(range(2, 52))
    assert len({scene.seed for scene in scenes}) == len(scenes)
    other = planned(tmp_path, recordings, ncpa={"total_nm": 142}, seed=6)["a"].scene
    assert other.ncpa_nm != scenes[0].ncpa_nm


def test_a_recording_added_behind_leaves_those_before_it_as_they_are(tmp_path):
    before = planned(tmp_path, {"a": CUBE, "ramp": RAMP})
    after = planned(tmp_path, {"a": CUBE | {"frames": 500}, "ramp": RAMP, "b": CUBE})
    assert all(before[name] == after[name] for name in before if name != "a")


def test_named_bands_are_those_of_the_instrument(tmp_path):
    recordings = {name: CUBE | {"bands": name} for name in ("narrow_h", "j", "h", "j_h")}
    scenes = {name: one.scene for name, one in planned(tmp_path, recordings).items()}
    nodes = {name: [nm for nm, _ in scene.spectrum(3)] for name, scene in scenes.items()}
    assert nodes["j_h"] == nodes["j"] + nodes["h"]
    # Gauss–Legendre nodes lie √0.6 half widths from the centre; half widths are whole nanometres.
    assert nodes["j_h"] == pytest.approx([1170, 1215, 1260, 1560, 1625, 1690], abs=0.1)
    assert scenes["narrow_h"].bands[0].half_width_nm == 20
    assert scenes["j"].photons == scenes["h"].photons == scenes["j_h"].photons / 2
    assert scenes["narrow_h"].photons == pytest.approx(0.14 * scenes["j_h"].photons)


def test_bands_of_ones_own_share_the_photons(tmp_path):
    bands = [{"centre_nm": nm, "half_width_nm": 50, "share": share} for nm, share in ((1200, 1), (1600, 3))]
    scene = planned(tmp_path, {"one": CUBE | {"bands": bands}})["one"].scene
    assert [band.share for band in scene.bands] == [0.25, 0.75]
