"""The table of pulls. Truth: pulls of made-up errors, by hand."""

from __future__ import annotations

import numpy as np

from benchmarks.pulls import table as tables
from benchmarks.pulls.cases import SEEINGS_ARCSEC, SHAPES, Case


def made(index: int, pull: float) -> dict:
    case = Case(1, index, 20)
    cube = {"error_nm": [2 * pull, -pull], "sigma_nm": [2.0, 1.0], "chi2": 2 * pull**2}
    ramp = {
        "error_nm": [3 * pull, 3 * pull],
        "sigma_nm": [3.0, 3.0],
        "photon_nm": [0.0, 0.0],
        "instant_nm": 0.0,
        "optics_nm": [3.0, 3.0],
    }
    return {"seeing_arcsec": case.seeing_arcsec, "shape": case.shape, "cube": cube, "ramp": ramp}


def test_cases_go_through_all_seeings_and_shapes():
    cases = [Case(1, index, 20) for index in range(16)]
    assert {(one.seeing_arcsec, one.shape) for one in cases} == {
        (seeing, shape) for seeing in SEEINGS_ARCSEC for shape in SHAPES
    }


def test_pulls_are_quadratic_means_by_group_and_of_all():
    text = tables.table([made(0, 1.0), made(1, 2.0)])
    rows = {
        row.split("|")[2].strip(): [cell.strip() for cell in row.split("|")] for row in text.splitlines()[2:]
    }
    assert rows["0.35″"][5].startswith("1.00") and rows["0.5″"][5].startswith("2.00")
    everything = rows["**all**"]
    assert everything[1] == "2" and everything[5].startswith(f"{np.sqrt(2.5):.2f} (1.00–2.00)")
    assert everything[6] == "2.50" and everything[9].startswith("1.58")
    assert everything[10] == f"{np.sqrt((1 + 4) / 2):.2f}"


def test_the_table_stands_between_its_marks(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- pulls -->\nold\n<!-- /pulls -->\nafter\n")
    monkeypatch.setattr(tables, "PAGE", page)
    tables.write_page("new")
    assert page.read_text() == "before\n<!-- pulls -->\n\nnew\n\n<!-- /pulls -->\nafter\n"
