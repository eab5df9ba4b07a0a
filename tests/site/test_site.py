"""The documentation site builds without a warning, and its reference has what the package has."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.paths import REPOSITORY

from irlos_pipe.commands.main import cli
from irlos_pipe.conventions.errors import ExitCode
from irlos_pipe.effects.catalogue import CATALOGUE
from irlos_pipe.reference.lookup import all_entries
from irlos_pipe.reference.pages import EXITS, pages

PAGE_OF = {
    "key of a recipe": "keys",
    "key of a side-car": "sidecar",
    "key of a profile": "profile",
    "fact of a profile": "profile",
    "check": "checks",
    "number": "results",
    "array of a product": "products",
    "term": "glossary",
}


def test_every_entry_stands_on_its_page():
    text = pages()
    for entry in all_entries():
        if entry.kind in PAGE_OF:
            page = text[PAGE_OF[entry.kind]]
            last = entry.name if entry.kind == "term" else entry.name.rpartition(".")[2]
            assert last in page, f"{entry.kind} {entry.name}"


def test_every_exit_code_is_explained():
    assert set(EXITS) == set(ExitCode)


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
