"""`irlos simulate` as its user meets it, and from there through the reduction to the score."""

import json
from types import SimpleNamespace

import pytest
from conftest import invoke
from helpers.paths import RECIPES
from helpers.simulation_specs import CUBE, RAMP, spec_of, written

NIGHT = {"cube": CUBE, "ramp": RAMP}


@pytest.fixture
def spec(tmp_path) -> str:
    return str(written(tmp_path / "spec.yaml", spec_of(NIGHT)))


def test_a_dry_run_tells_what_would_be_made_and_touches_nothing(spec, tmp_path):
    seven = ("--dry-run", "--set", "recordings.cube.frames=7")
    result = invoke("simulate", spec, "--output", str(tmp_path / "out"), *seven)
    first, *ramp = result.stdout.splitlines()
    assert result.exit_code == 0 and not (tmp_path / "out").exists() and len(ramp) == 3
    assert first.split()[:4] == ["cube", "7", "x", "0.1"] and first.endswith("simulate  not there yet")


def test_a_second_run_says_that_all_is_up_to_date_and_what_changed_otherwise(spec, tmp_path):
    arguments = ("simulate", spec, "--output", str(tmp_path / "out"), "--jobs", "1")
    invoke(*arguments)
    names = ("cube", "ramp/offset_00", "ramp/offset_01", "ramp/offset_02")
    assert invoke(*arguments).stderr.splitlines() == [f"irlos: {name}: up to date" for name in names]
    lines = invoke(*arguments, "--dry-run", "--seed", "8").stdout.splitlines()
    assert all("changed: " in line and "seed" in line for line in lines)
    assert all("--force" in line for line in invoke(*arguments, "--dry-run", "--force").stdout.splitlines())


def test_wrong_settings_exit_with_2_one_line_each_and_no_folder(spec, tmp_path):
    wrong = ["--set", "recordings.cube.frmes=3", "--set", "sed=1"]
    result = invoke("simulate", spec, "--output", str(tmp_path / "out"), *wrong)
    assert result.exit_code == 2 and not (tmp_path / "out").exists()
    assert [line.split(": ", 3)[2:] for line in result.stderr.splitlines()] == [
        ["--set recordings.cube.frmes", "unknown key 'recordings.cube.frmes'; did you mean 'frames'?"],
        ["--set sed", "unknown key 'sed'; did you mean 'seed'?"]]  # fmt: skip


def test_a_simulation_that_the_disk_cannot_hold_is_refused_before_it_begins(spec, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=100))
    result = invoke("simulate", spec, "--output", str(tmp_path / "out"))
    assert result.exit_code == 2 and "the recordings take 0.0 GB, 0.0 are free" in result.stderr


def test_a_folder_with_files_of_others_exits_with_2(spec, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    result = invoke("simulate", spec, "--output", str(tmp_path / "out"))
    assert result.exit_code == 2 and "holds other files (thesis.tex)" in result.stderr


@pytest.mark.slow
def test_simulated_sky_data_are_reduced_and_scored_like_measured_ones(tmp_path):
    cube = CUBE | {"frames": 12, "mag_j": 7.0, "window": [40, 40], "detector": {"e_per_adu": 2.0}}
    sky = spec_of({"calibration": cube}, ncpa={"total_nm": 100, "modes": 9}, sky={"seeing_arcsec": 0.4})
    fine = {"pupil_samples": 64, "points_per_band": 3, "step_s": 0.02}
    path = written(tmp_path / "sky.yaml", sky | {"sampling": fine, "motion": {"rms_mas": 5}})
    out, run = tmp_path / "sim", tmp_path / "sim" / "run"
    assert invoke("simulate", str(path), "--output", str(out), "-q", "--jobs", "1").exit_code == 0
    options = ["--to", "calibrate", "--device", "cpu", "--jobs", "1", "--set", "calibrate.highest_noll=14"]
    given = ("--input", f"calibration={out}/data/calibration", "--output", str(run))
    result = invoke("run", str(RECIPES / "ncpa_calibration.yaml"), *given, *options)
    assert result.exit_code in (0, 4), result.stderr
    row = json.loads((run / "results.json").read_text())["stages"]["ingest"]["inputs"][0]
    assert (row["frames"], row["frames_missing"], row["window"]) == (12, 0, [40, 40])
    table = invoke("score", str(run), "--truth", str(out / "truth")).stdout.splitlines()
    error_nm = float(table[1].split()[1])
    # 12 frames of 0.1 s: the speckles of the residual leave some nm in every low mode; without a
    # calibration the error would be the NCPAs themselves, 100 nm.
    assert table[0].startswith("calibration (calibration)") and error_nm < 30
