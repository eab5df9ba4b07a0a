"""Simulation specs: what is accepted, what is refused, how it is told. Expectations are written by hand."""

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from helpers.paths import RECIPES
from helpers.simulation_specs import CUBE, RAMP, planned, simulated, spec_of, truth, written

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.json import jsonable
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.recordings.files import side_car
from irlos_pipe.simulate.recordings.run import SimulationFolder, made_from
from irlos_pipe.simulate.recordings.spec import load_spec, plan_recordings

EXAMPLES = sorted((RECIPES / "simulations").glob("*.yaml"))
LENSLETS = "20x20_SmallScale_500Hz_HighGain"


def refusal(tmp_path: Path, spec: dict, *settings: str) -> list[str]:
    """Lines of the error, without the folder."""
    with pytest.raises(ConfigurationError) as error:
        load_spec(written(tmp_path / "spec.yaml", spec), settings)
    return str(error.value).replace(f"{tmp_path}/", "").splitlines()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_example_specs_are_valid_and_say_how_to_use_them(path):
    assert plan_recordings(load_spec(path))
    assert f"irlos simulate {path.stem} --output" in path.read_text()


def test_every_mistake_is_told_at_once_with_line_and_suggestion(tmp_path):
    spec = spec_of(
        {"cal": CUBE | {"role": "ncpa_calibraton", "effects": {"vibratin": {"sigma_mas": 1}}}}, sed=3
    )
    lines = refusal(tmp_path, spec, "recordings.cal.frames=0")
    text = written(tmp_path / "again.yaml", spec).read_text().splitlines()
    role, effect = (
        1 + next(i for i, line in enumerate(text) if word in line) for word in ("role:", "vibratin")
    )
    assert lines[0].startswith("--set recordings.cal.frames: recordings.cal.frames = 0: should be")
    assert f"spec.yaml:{role}: recordings.cal.role = 'ncpa_calibraton'" in lines[1]
    assert "did you mean 'ncpa_calibration'?" in lines[1]
    assert (
        lines[2]
        == f"spec.yaml:{effect}: unknown key 'recordings.cal.effects.vibratin'; did you mean 'vibration'?"
    )
    assert "unknown key 'sed'; did you mean 'seed'?" in lines[3] and len(lines) == 4


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("exposure_s", ".nan"), ("frames", "100000000"), ("window", "[4, 64]"), ("offsets_nm", "[1.0e+9]"),
        ("sky.seeing_arcsec", "0"), ("ncpa.zernike_nm", "{1: 5}"), ("effects.companion.flux_ratio", "1.1"),
        ("bands", f"{2000 * [{'centre_nm': 1600, 'half_width_nm': 20}]}"),
    ],
)  # fmt: skip
def test_values_that_make_no_sense_are_refused_in_one_line(tmp_path, key, value):
    recording = RAMP if key == "offsets_nm" else CUBE
    recording = recording | {"effects": {"companion": {"flux_ratio": 0.1, "sep_mas": 100, "pa_deg": 0}}}
    lines = refusal(tmp_path, spec_of({"one": recording}), f"recordings.one.{key}={value}")
    assert len(lines) == 1 and lines[0].startswith(f"--set recordings.one.{key}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame_rate_hz": 20}, "longer than the 0.05 s that frame_rate_hz = 20 leaves"),
        ({"offsets_nm": [0, 1]}, "set role: defocus_ramp"),
        ({"layout": "muse_raw", "angles_deg": [0, 1]}, "holds one cube"),
        ({"mode": LENSLETS, "layout": "recorder"}, "is one of MUSE raw files; use layout: muse_raw"),
        ({"mode": LENSLETS, "window": [21, 20]}, "window [21, 20] has no four equal images"),
        ({"pupil": {"obscuration_m": 8.0}}, "pupil.obscuration_m = 8 leaves nothing"),
        ({"effects": {"bad_pixels": [[30, 2]]}}, "[30, 2] lies outside the window"),
        ({"effects": {"spectrum": {"wavelength_nm": 10}}}, "true weighted mean, not its shift"),
        ({"effects": {"low_wind_effect": {"tip_nm": [1, 2]}}}, "tip_nm: the pupil has 4 petals"),
        ({"effects": {"diversity_error": {"nm": 9}}, "diversity": None}, "needs a diversity"),
        ({"ncpa": {"total_nm": 3, "tail_nm": 2, "tail_nolls": [200, 52]}}, "first and the last Noll index"),
        ({"ncpa": {"total_nm": 3, "zernike_nm": {4: 1}}}, "give either total_nm"),
        ({"detector": {"e_per_adu": 9.8}}, "below the noise of rounding"),
        ({"sky": {"shape": "servo_lag", "wind_m_s": 0}}, "needs wind"),
        ({"motion": {"lines": [{"hz": hz, "share_x": 0.7, "share_y": 0} for hz in (5, 6)]}}, "more than 1"),
    ],
)  # fmt: skip
def test_values_that_contradict_each_other_are_told(tmp_path, change, message):
    lines = refusal(tmp_path, spec_of({"one": CUBE | change}))
    assert len(lines) == 1 and message in lines[0] and lines[0].startswith("spec.yaml:")


def test_a_recording_changes_shared_sections_key_by_key_for_itself_alone(tmp_path):
    recordings = {
        "plain": CUBE,
        "own": CUBE | {"sky": {"slope": 1.5}, "detector": {"e_per_adu": 2.0},
                       "effects": {"vibration": {"sigma_mas": 5}}},
        "bench": CUBE | {"sky": None, "effects": None},
        "same": CUBE | {"sky": {}, "effects": {"plate_scale": None}},
    }  # fmt: skip
    shared = {
        "sky": {"seeing_arcsec": 0.8},
        "detector": {"read_noise_e": 3.0},
        "effects": {"plate_scale": {"fraction": 0.01}},
    }
    plain, own, bench, same = (one.scene for one in planned(tmp_path, recordings, **shared).values())
    assert (plain.sky.seeing_arcsec, plain.sky.slope, plain.detector.e_per_adu) == (0.8, 2.0, 0.5)
    assert (own.sky.seeing_arcsec, own.sky.slope) == (0.8, 1.5)
    assert (own.detector.e_per_adu, own.detector.read_noise_e) == (2.0, 3.0)
    assert own.effects.keys() == {"plate_scale", "vibration"} and plain.effects.keys() == {"plate_scale"}
    assert bench.sky is None and not bench.effects and bench.detector.read_noise_e == 3.0
    assert same.sky == plain.sky and not same.effects


def test_the_resolved_spec_makes_the_same_recordings(tmp_path):
    spec = load_spec(EXAMPLES[0].parent / "on_sky.yaml", ["effects.bad_pixels=[[3, 4]]"], seed=4)
    path = tmp_path / "resolved.yaml"
    path.write_text(spec.resolved_yaml())
    assert jsonable(plan_recordings(load_spec(path))) == jsonable(plan_recordings(spec))


# The recordings of a series: order, travel of the focus stage, angles, seeds. Expectations are by hand.


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


def test_recordings_share_the_ncpas_and_nothing_else_that_is_random(tmp_path):
    recordings = {"a": CUBE, "ramp": RAMP, "b": CUBE}
    scenes = [one.scene for one in planned(tmp_path, recordings, ncpa={"total_nm": 142}).values()]
    assert all(scene.ncpa_nm == scenes[0].ncpa_nm for scene in scenes)
    assert np.linalg.norm(list(scenes[0].ncpa_nm.values())) == pytest.approx(142)
    assert sorted(scenes[0].ncpa_nm) == list(range(2, 52))
    assert len({scene.seed for scene in scenes}) == len(scenes)
    other = planned(tmp_path, recordings, ncpa={"total_nm": 142}, seed=6)["a"].scene
    assert other.ncpa_nm != scenes[0].ncpa_nm


# The truth of simulated recordings. Expected: the coefficients put in, and Zernikes turned by hand.


@pytest.mark.slow
def test_the_truth_is_the_wavefront_that_was_put_in(tmp_path):
    ncpa = {4: 30.0, 7: -20.0, 31: 10.0}
    effects = {
        "focus_stage_offset": {"nm": 25},
        "companion": {"flux_ratio": 0.1, "sep_mas": 90, "pa_deg": 0},
    }
    ramp = RAMP | {"effects": effects, "sampling": {"pupil_samples": 96}}
    simulated(tmp_path / "out", spec_of({"ramp": ramp}, ncpa={"zernike_nm": ncpa}))
    told = truth(tmp_path / "out", "ramp__offset_02")
    assert told["hidden"].keys() == effects.keys() and told["introduced_defocus_nm"] == 200
    assert {int(noll): nm for noll, nm in told["ncpa_nm"].items()} == ncpa
    mean = {int(noll): nm for noll, nm in told["mean_zernike_nm"].items()}
    expected = dict.fromkeys(range(2, 32), 0.0) | ncpa | {4: 30.0 + 200 + 25}
    assert mean == pytest.approx(expected, abs=1e-6)


def test_the_truth_of_a_derotator_series_turns_with_the_angle(tmp_path):
    series = {"turns": CUBE | {"role": "derotator", "angles_deg": [0, 45]}}
    fixed, turning = {"zernike_nm": {4: 10.0}}, {"zernike_nm": {6: 30.0}}
    simulated(tmp_path / "out", spec_of(series, ncpa=fixed, rotating=turning))
    # cos 2(theta - 45 deg) = sin 2 theta: vertical astigmatism, Noll 6, becomes oblique, Noll 5.
    expected = ({6: 30.0, 4: 10.0}, {5: 30.0, 4: 10.0})
    for index, zernike_nm in enumerate(expected):
        found = truth(tmp_path / "out", f"turns__angle_0{index}")
        for key in ("ncpa_nm", "mean_zernike_nm"):
            values = {int(noll): nm for noll, nm in found[key].items() if abs(nm) > 1e-6}
            assert values == pytest.approx(zernike_nm)


def test_a_truth_that_names_a_folder_elsewhere_removes_nothing_there(tmp_path):
    target = SimulationFolder(tmp_path / "sim")
    (tmp_path / "sim" / "truth").mkdir(parents=True)
    (tmp_path / "sim" / "data" / "mine").mkdir(parents=True)
    (tmp_path / "precious").mkdir()
    for name, told in (("x", "../../precious"), ("y", "mine"), ("z", ".")):
        forged = {"simulation": {"recording": {"name": told}}}
        (tmp_path / "sim" / "truth" / f"{name}.json").write_text(json.dumps(forged))
        target.remove(name)
    assert (tmp_path / "precious").is_dir()
    assert list((tmp_path / "sim" / "data").iterdir()) == []
    assert list((tmp_path / "sim" / "truth").iterdir()) == []


@pytest.mark.parametrize("name", ["a/b", "..", "a__b", ".hidden", "ä"])
def test_a_recording_name_that_makes_no_folder_is_refused(tmp_path, name):
    assert "becomes the name of a folder" in refusal(tmp_path, spec_of({name: CUBE}))[0]


def test_a_tail_of_fine_modes_is_added_to_the_draw_and_leaves_it_as_it_is(tmp_path):
    """149 normal numbers: their RMS is known to 6 %."""
    drawn = {"total_nm": 100.0, "modes": 50}
    with_tail = drawn | {"tail_nm": 2.0, "tail_nolls": [52, 200]}
    plain, fine = (
        planned(tmp_path, {"one": CUBE | {"ncpa": ncpa}})["one"].scene.ncpa_nm for ncpa in (drawn, with_tail)
    )
    tail = [fine[noll] for noll in range(52, 201)]
    assert {noll: fine[noll] for noll in plain} == plain and len(fine) == 199
    assert (sum(value**2 for value in tail) / 149) ** 0.5 == pytest.approx(2.0, rel=0.2)


def test_a_pupil_may_differ_from_the_profile_in_its_hole(tmp_path):
    one = planned(tmp_path, {"one": CUBE}, pupil={"obscuration_m": 1.2})["one"]
    nominal = load_instrument("irlos").pupil
    assert one.scene.geometry.obscuration_m == 1.2
    assert one.scene.geometry.vanes == nominal.vanes and nominal.obscuration_m != 1.2


def test_bands_of_ones_own_share_the_photons(tmp_path):
    bands = [{"centre_nm": nm, "half_width_nm": 50, "share": share} for nm, share in ((1200, 1), (1600, 3))]
    scene = planned(tmp_path, {"one": CUBE | {"bands": bands}})["one"].scene
    assert [band.share for band in scene.bands] == [0.25, 0.75]


def test_a_side_car_states_a_profile_of_ones_own_so_that_it_is_not_forgotten(tmp_path):
    shipped = files("irlos_pipe.instrument") / "bench.yaml"
    (tmp_path / "mine.yaml").write_text(shipped.read_text())
    (own,) = planned(tmp_path, {"cube": CUBE}, instrument="mine.yaml").values()
    (standard,) = planned(tmp_path, {"cube": CUBE}).values()
    assert side_car(own)["instrument"] == str(tmp_path / "mine.yaml")
    assert "instrument" not in side_car(standard) and "instrument" not in made_from(standard)["recording"]
