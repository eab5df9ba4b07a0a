"""The documentation site builds without a warning, and its reference has what the package has."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.paths import REPOSITORY

from irlos_pipe.commands.main import cli
from irlos_pipe.conventions.errors import EXIT_MEANINGS, ExitCode
from irlos_pipe.effects.catalogue import CATALOGUE


def test_every_exit_code_is_explained():
    assert set(EXIT_MEANINGS) == set(ExitCode)


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("furo")
    pytest.importorskip("myst_nb")
    pytest.importorskip("sphinx_copybutton")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "docs", str(tmp_path / "html")]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    html = {path.stem: path.read_text() for path in Path(tmp_path / "html").rglob("*.html")}
    assert all(f"irlos {name}" in html["commands"] for name in cli.commands)
    assert all(name in html["effects"] for name in CATALOGUE)
    plots = re.findall(r'<img[^>]*src="([^"]*)"', html["gallery"])  # each its own, drawn by the code above it
    assert len(plots) == len(set(plots)) > 8
    assert "calibrate(" in html["api"] and "irlos_pipe.Focus" in html["api"]
