"""The tutorial is executed, cell by cell, in an empty folder."""

import json

import matplotlib
import pytest
from helpers.paths import REPOSITORY

NOTEBOOK = REPOSITORY / "docs" / "tutorial.ipynb"


def cells() -> list[str]:
    content = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == "code"]


@pytest.mark.long
def test_every_cell_runs_and_the_numbers_are_those_that_the_text_speaks_of(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    names: dict = {}
    for source in cells():
        exec(compile(source, NOTEBOOK.name, "exec"), names)
    # truth: the sample's own, made by another code than the model
    assert names["error_nm"] < 6 and 0.5 < float(names["pulls"].std()) < 1.7
    assert abs(names["summary"]["slope"] - 1) < 0.015 and names["summary"]["rms_nm"] < 6
    assert "Shrink (term)" in capsys.readouterr().out
