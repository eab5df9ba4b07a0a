"""All methods with the same modes and frames. Truth: what was drawn, medians of made-up numbers."""

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import drawn, missed, run_on, tables_of

from irlos_pipe.paper import ranking
from irlos_pipe.paper.common.calibrations import DEFAULT, METHOD_NAMES
from irlos_pipe.paper.common.scenes import cube_scene
from irlos_pipe.paper.ranking import OWN, with_tail

SCENE = cube_scene("test", (31, 0), cases.FACILITY, 0.35, 6, 7.0)


def test_a_tail_follows_the_drawn_ncpas_and_leaves_these_alone():
    without, tailed = SCENE.ncpa_nm, with_tail(SCENE, 3.0).ncpa_nm
    assert with_tail(SCENE, 0.0) is SCENE and set(without) == set(range(2, 52))
    assert set(tailed) == set(range(2, 201))
    assert all(tailed[noll] == without[noll] for noll in without)
    # 149 draws of 3 nm: their RMS is 3 nm within 3 / sqrt(2 · 149), here four times that.
    assert np.std([tailed[noll] for noll in range(52, 201)]) == pytest.approx(3.0, abs=0.7)


@pytest.mark.parametrize(("open_nm", "kept"), [(2.0, True), (19.0, False)])
def test_a_default_that_another_method_beats_fails_its_check(monkeypatch, open_nm, kept):
    errors_nm = {(method, fitted): 40.0 for method in METHOD_NAMES for fitted in ("29 modes", "65 modes")}
    errors_nm |= {("lift_slices", "65 modes"): 18.0, (DEFAULT, "open"): open_nm}

    def rows(star):
        ncpa_nm = list(star.cube(0.35, 10, 7.0).ncpa_nm.values())
        drawn = {"introduced_nm": np.linalg.norm(ncpa_nm)}
        for (method, fitted), error_nm in errors_nm.items():
            yield {"method": method, "fitted": fitted, "frames": 300, "error_nm": error_nm, **drawn}
        for method in METHOD_NAMES if star["parts"] else ():
            yield {"method": method, "fitted": OWN, "frames": 10, "error_nm": 50.0, **drawn}

    sizes = {"samples_of_tails": 0, "samples_of_parts": 1, "seeings_arcsec": (0.35,)}
    output = run_on(monkeypatch, ranking, rows, samples=40, **sizes)
    assert (not missed(output)) is kept
    assert (
        output.checks[0].value == pytest.approx(open_nm / 18.0) and "LIFT slices" in output.checks[0].message
    )
    table = tables_of(output)["methods"]
    assert set(table.query(f"fitted == '{OWN}'").cubes) == {1}
    # 142 ± 30 nm as drawn: the mean of 40 within 3 · 30 / sqrt(40).
    assert table.introduced_nm[0] == pytest.approx(142, abs=15)
    assert table.introduced_scatter_nm[0] == pytest.approx(30, abs=11)
    figure, modes, _, frames = drawn(output, ranking).blocks
    assert "LIFT slices" in figure.svg
    assert (len(modes.rows), len(frames.rows)) == (6, 6)
