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
def test_every_drawing_of_the_page_is_written_in_every_format_and_earlier_ones_are_moved_away(folder):
    page = write_report(folder).read_text()
    (folder / "figures").mkdir()
    (folder / "figures" / "old.pdf").write_text("old")
    result = invoke("report", str(folder), "--figures", "--format", "svg", "--format", "png")
    assert result.exit_code == 0, result.stderr
    assert (folder / "earlier" / "figures" / "old.pdf").is_file()
    files = sorted(path.name for path in (folder / "figures").iterdir())
    assert len(files) == 2 * len(re.findall("<svg ", page)) > 0
    for path in (folder / "figures").glob("*.svg"):
        assert path.read_bytes().startswith(b"<?xml") and b"currentColor" not in path.read_bytes()
    image = imread(next((folder / "figures").glob("*.png")))
    assert image[0, 0].tolist() == [1, 1, 1, 1] and image.std() > 0.01


@pytest.mark.slow
def test_figures_are_not_written_through_a_link(folder):
    (folder / "elsewhere").mkdir()
    (folder / "figures").symlink_to(folder / "elsewhere")
    result = invoke("report", str(folder), "--figures")
    assert result.exit_code == 1 and "nothing is written" in result.stderr
    assert not list((folder / "elsewhere").iterdir())


def test_a_format_without_figures_is_a_mistake(folder):
    assert invoke("report", str(folder), "--format", "pdf").exit_code == 2
