"""Simulation specs: what is accepted, what is refused, how it is told. Expectations are written by hand."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.paths import RECIPES
from helpers.simulation_specs import CUBE, RAMP, planned, spec_of, written

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.json import jsonable
from irlos_pipe.simulate.recordings.spec import load_spec, plan_recordings

EXAMPLES = sorted((RECIPES / "simulations").glob("*.yaml"))
LENSLETS = "20x20_SmallScale_500Hz_HighGain"


def loaded(tmp_path: Path, spec: dict, *settings: str, **options):
    return load_spec(written(tmp_path / "spec.yaml", spec), settings, **options)


def refusal(tmp_path: Path, spec: dict, *settings: str) -> list[str]:
    """Lines of the error, without the folder."""
    with pytest.raises(ConfigurationError) as error:
        loaded(tmp_path, spec, *settings)
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
        ("mag_j", ".inf"), ("exposure_s", ".nan"), ("exposure_s", "-1"), ("frames", "1.5"),
        ("frames", "100000000"),
        ("window", "[4, 64]"), ("pixel_scale_mas", "0"), ("offsets_nm", "[.nan]"), ("offsets_nm", "[1.0e+9]"),
        ("sky.seeing_arcsec", "0"), ("motion.rms_mas", "-3"), ("detector.e_per_adu", "0"),
        ("detector.excess_noise_factor", "0.5"), ("detector.flat_rms", "7"), ("ncpa.total_nm", "1e99"),
        ("ncpa.zernike_nm", "{1: 5}"), ("pupil.obscuration_m", "-1"),
        ("effects.companion.flux_ratio", "-.inf"), ("effects.companion.flux_ratio", "1.1"), ("bands", "[]"),
        ("bands", "[{centre_nm: 600, half_width_nm: 500}]"), ("effects.low_wind_effect.piston_nm", "[]"),
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
        ({"introduced_nm": [1, 2]}, "2 values for 3 frames"),
        ({"angles_deg": [0, 1], "offsets_nm": [1], "role": "defocus_ramp"}, "not both"),
        ({"layout": "muse_raw", "angles_deg": [0, 1]}, "holds one cube"),
        ({"mode": LENSLETS, "layout": "recorder"}, "is one of MUSE raw files; use layout: muse_raw"),
        ({"mode": LENSLETS, "window": [21, 20]}, "window [21, 20] has no four equal images"),
        ({"mode": LENSLETS, "lenslet_images": {"x_mas": [0, 0, 0]}}, "x_mas.3' is missing"),
        ({"lenslet_images": {"flux": [0, 0, 0, 0]}}, "has no lenslets"),
        ({"start": "2020-99-14T03:21:10"}, "month must be in 1..12"),
        ({"detector": {"dead": [[3, 24]]}}, "[3, 24] lies outside the window of [24, 24]"),
        ({"pupil": {"obscuration_m": 8.0}}, "pupil.obscuration_m = 8 leaves nothing"),
        ({"effects": {"bad_pixels": [[30, 2]]}}, "[30, 2] lies outside the window"),
        ({"effects": {"spectrum": {"wavelength_nm": 10}}}, "true weighted mean, not its shift"),
        ({"effects": {"spectrum": {"weights": [1, 2]}}}, "give one per band, 1"),
        ({"effects": {"low_wind_effect": {"tip_nm": [1, 2]}}}, "tip_nm: the pupil has 4 petals"),
        ({"effects": {"segment_piston": {"piston_nm": [1, 2]}}}, "the pupil has 4 segments; give as many"),
        ({"effects": {"diversity_error": {"nm": 9}}, "diversity": None}, "needs a diversity"),
        ({"effects": {"seeing_halo": {}}}, "seeing_halo = {}: give either scale or wfe_nm"),
        ({"ncpa": {}}, "give either total_nm"),
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
