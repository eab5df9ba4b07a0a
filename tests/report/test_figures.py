"""Figures as files; truth is what the page of the same run shows."""

import re

import pytest
from conftest import invoke
from helpers import made_run
from matplotlib.image import imread

from irlos_pipe.report.build import write_report


@pytest.fixture
def folder(tmp_path):
    return made_run.write_run(tmp_path, made_run.products("ingest", "calibrate"))


@pytest.mark.slow
def test_every_drawing_of_the_page_is_written_in_every_format_asked_for(folder):
    page = write_report(folder).read_text()
    result = invoke("report", str(folder), "--figures", "--format", "svg", "--format", "png")
    assert result.exit_code == 0, result.stderr
    files = sorted(path.name for path in (folder / "figures").iterdir())
    assert len(files) == 2 * len(re.findall("<svg ", page)) > 0
    assert result.stdout.splitlines()[1:] == [str(folder / "figures" / name) for name in _as_listed(result)]
    for path in (folder / "figures").glob("*.svg"):
        assert path.read_bytes().startswith(b"<?xml") and b"currentColor" not in path.read_bytes()
    image = imread(next((folder / "figures").glob("*.png")))
    assert image[0, 0].tolist() == [1, 1, 1, 1] and image.std() > 0.01


def _as_listed(result):
    return [line.rpartition("/")[2] for line in result.stdout.splitlines()[1:]]


@pytest.mark.slow
def test_earlier_figures_are_moved_away_and_a_link_is_not_followed(folder, tmp_path):
    (folder / "figures").mkdir()
    (folder / "figures" / "old.pdf").write_text("old")
    assert invoke("report", str(folder), "--figures", "--format", "pdf").exit_code == 0
    assert (folder / "earlier" / "figures" / "old.pdf").is_file()
    assert not (folder / "figures" / "old.pdf").exists()
    assert all(path.read_bytes().startswith(b"%PDF") for path in (folder / "figures").iterdir())
    (folder / "elsewhere").mkdir()
    (folder / "figures").rename(folder / "moved")
    (folder / "figures").symlink_to(folder / "elsewhere")
    result = invoke("report", str(folder), "--figures")
    assert result.exit_code == 1 and "nothing is written" in result.stderr
    assert not list((folder / "elsewhere").iterdir())


def test_a_format_without_figures_is_a_mistake(folder):
    assert invoke("report", str(folder), "--format", "pdf").exit_code == 2
