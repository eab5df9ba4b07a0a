"""The recordings of a series: order, travel of the focus stage, angles, seeds. Expectations are by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.simulation_specs import CUBE, RAMP, planned

FIVE = [-200, -100, 0, 100, 200]


def reached_nm(folder: Path, effects: dict, **ramp) -> list[float]:
    """Defocus that a ramp of five offsets reaches, in the order of the offsets."""
    recordings = {"ramp": RAMP | {"offsets_nm": FIVE, "effects": effects} | ramp}
    return [one.scene.introduced_nm for one in planned(folder, recordings).values()]


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
