"""The shipped recordings through all stages, as a newcomer runs them first; the last one is cut short."""

import json

import pytest
from conftest import invoke

SHORT = ("sensitivity.mag_step=4", "sensitivity.realisations=2", "sensitivity.frames_per_offset=2")
STAGES = {"ingest", "prior", "calibrate", "lift", "sensitivity"}


@pytest.mark.slow
def test_the_demo_runs_to_its_end_and_passes_its_checks(tmp_path):
    settings = [word for one in SHORT for word in ("--set", one)]
    outcome = invoke("demo", "--output", str(tmp_path / "demo"), *settings, "--jobs", "1")
    assert outcome.exit_code == 0, outcome.output
    results = json.loads((tmp_path / "demo" / "results.json").read_text())
    assert results["status"] == "ok"
    assert results["stages"].keys() >= STAGES
