"""`irlos simulate` as its user meets it, and from there through the reduction to the score."""

from types import SimpleNamespace

import pytest
from conftest import invoke
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


def test_a_simulation_that_the_disk_cannot_hold_is_refused_before_it_begins(spec, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=100))
    result = invoke("simulate", spec, "--output", str(tmp_path / "out"))
    assert result.exit_code == 2 and "the recordings take 0.0 GB, 0.0 are free" in result.stderr
