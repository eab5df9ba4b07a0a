"""The random instrument: one draw to its end. Truth: what was drawn."""

import numpy as np
import pytest

from benchmarks.random_instrument import (
    SUITE,
    Case,
    judged,
)
from irlos_pipe.conventions.modes import REPORTED_NOLLS

SMALL = Case(1, 0, 8, window=36)


@pytest.mark.slow
def test_a_draw_is_simulated_calibrated_and_kept(tmp_path):
    outcome = SUITE.work(SMALL, tmp_path)
    scene, static_nm = SMALL.planned(tmp_path / "spec.yaml").scene, outcome["truth"]["static_nm"]
    effects = scene.effects
    filter_nm, missed_nm = effects["filter_ncpa"]["zernike_nm"], effects["diversity_error"]["nm"]
    assert static_nm["6"] == pytest.approx(scene.ncpa_nm[6] + filter_nm[6] - missed_nm)
    assert outcome["truth"]["diversity_error_nm"]["6"] == pytest.approx(-missed_nm)
    one = judged(outcome, "plain")
    assert one["error_nm"] < np.linalg.norm([static_nm[str(noll)] for noll in REPORTED_NOLLS]) / 2
    assert one["red"] == bool(outcome["plain"]["failed"])
