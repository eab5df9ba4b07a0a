"""All methods with the same modes and frames. Truth: what was drawn, medians of made-up numbers."""

import numpy as np
import pytest
from helpers import optics_cases as cases

from irlos_pipe.paper.common.scenes import cube_scene
from irlos_pipe.paper.ranking import with_tail

SCENE = cube_scene("test", (31, 0), cases.FACILITY, 0.35, 6, 7.0)


def test_a_tail_follows_the_drawn_ncpas_and_leaves_these_alone():
    without, tailed = SCENE.ncpa_nm, with_tail(SCENE, 3.0).ncpa_nm
    assert with_tail(SCENE, 0.0) is SCENE and set(without) == set(range(2, 52))
    assert set(tailed) == set(range(2, 201))
    assert all(tailed[noll] == without[noll] for noll in without)
    # 149 draws of 3 nm: their RMS is 3 nm within 3 / sqrt(2 · 149), here four times that.
    assert np.std([tailed[noll] for noll in range(52, 201)]) == pytest.approx(3.0, abs=0.7)
