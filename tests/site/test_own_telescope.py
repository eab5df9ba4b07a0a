"""docs/own_telescope.md is executed from top to bottom, in an empty folder."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.paths import REPOSITORY

import irlos_pipe

PAGE = REPOSITORY / "docs" / "own_telescope.md"
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


@pytest.mark.long
@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_the_page_works_as_it_stands_and_its_result_is_the_truth(tmp_path):
    printed = [execute(kind, text, tmp_path) for kind, text in BLOCK.findall(PAGE.read_text("utf-8"))]
    assert all(check.passed for check in irlos_pipe.open_run(tmp_path / "reduction").checks)
    assert (tmp_path / "ncpa.csv").read_text().startswith("#") or (tmp_path / "ncpa.csv").stat().st_size > 500
    # truth: what the simulator, which shares no optics with the model, drew
    (error_nm,) = re.findall(r"long_exposure .* ([0-9.]+) nm RMS +[0-9.]+$", printed[-1], re.MULTILINE)
    assert float(error_nm) < 1.5
