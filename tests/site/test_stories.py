"""The quick start and the two stories of the docs are executed from top to bottom, in an empty folder."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from helpers.paths import REPOSITORY

import irlos_pipe

DOCS = REPOSITORY / "docs"
BLOCK = re.compile(r"^```(yaml|sh|python)\n(.*?)^```", re.DOTALL | re.MULTILINE)
IRLOS = f'set -e; irlos() {{ "{sys.executable}" -m irlos_pipe "$@"; }}\n'


def execute(kind: str, text: str, folder: Path) -> str:
    """Do what a block says; returns what it prints."""
    if kind == "yaml":
        name = re.match(r"# (\S+)\n", text)
        assert name, "a block of YAML begins with the name of its file"
        (folder / name[1]).write_text(text)
        return ""
    command = ["bash", "-c", IRLOS + text] if kind == "sh" else [sys.executable, "-c", text]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{text}\n{done.stderr}"
    return done.stdout


def told(page: str, folder: Path) -> list[str]:
    """Do all blocks of a page; returns what each prints."""
    return [execute(kind, text, folder) for kind, text in BLOCK.findall((DOCS / page).read_text("utf-8"))]


def static_error_nm(score: str) -> float:
    """The error of a calibration against the static modes that the simulator drew."""
    (error_nm,) = re.findall(r"long_exposure .* ([0-9.]+) nm RMS +[0-9.]+$", score, re.MULTILINE)
    return float(error_nm)


@pytest.mark.slow
def test_five_minutes_with_one_array_find_the_truth(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    names: dict = {}
    for _, text in BLOCK.findall((DOCS / "quickstart.md").read_text("utf-8")):
        exec(compile(text, "quickstart.md", "exec"), names)
    assert all(check.passed for check in irlos_pipe.open_run(tmp_path / "first").checks)
    # truth: what the simulator of the sample, which shares no optics with the model, was given
    sample, table = names["sample"], names["table"][2:29]
    truth = json.loads((sample.parent / "truth" / f"{sample.name}.json").read_text())["ncpa_nm"]
    errors_nm = [row["zernike_nm"].value - truth[str(row["noll"])] for row in table]
    assert np.linalg.norm(errors_nm) < 4


@pytest.mark.long
def test_the_bench_camera_is_calibrated_as_its_page_says(tmp_path):
    printed = told("own_telescope.md", tmp_path)
    assert all(check.passed for check in irlos_pipe.open_run(tmp_path / "reduction").checks)
    assert (tmp_path / "ncpa.csv").read_text().startswith("#") or (tmp_path / "ncpa.csv").stat().st_size > 500
    # truth: what the simulator, which shares no optics with the model, drew
    assert static_error_nm(printed[-1]) < 1.5


@pytest.mark.long
def test_the_night_is_reduced_as_its_page_says(tmp_path):
    score = next(text for text in told("story_night.md", tmp_path) if "its pulls" in text)
    (ramp,) = (tmp_path / "reduced").glob("*/*_ramp/defocus_ramp")
    run = irlos_pipe.open_run(ramp)
    assert all(check.passed for check in run.checks)
    # truth: the introduced defocus, and what the simulator drew
    assert abs(run["lift"].results["summary"]["slope"] - 1) < 0.03 and static_error_nm(score) < 4
