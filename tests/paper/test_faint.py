"""How faint LIFT goes. Truth: the simulator, which shares no optics with LIFT's model; counting by hand."""

import numpy as np
import pytest
from helpers.experiment_stage import drawn, run_on, sample, tables_of

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL
from irlos_pipe.paper import faint
from irlos_pipe.paper.faint import COMPARED

ONE = {"exposures_s": (0.1,), "faintest_mag_j": (13.0,), "magnitudes": 2, "mag_step": 4.0}
SIZES = ONE | {"offsets": 2, "reach_nm": 100.0, "realisations": 2, "cube_frames": 20}
STAR = sample(faint, (33, 0), sizes=SIZES, sparta_arcsec=0.4, read=None)


@pytest.mark.slow
def test_calibrated_ncpas_leave_the_residual_of_the_sky():
    found = list(faint.rows(STAR))
    by_key = {row["key"]: row for row in found}
    assert all(by_key[key]["abs_error_nm"].shape == (2, 4) for key in COMPARED)
    default, none = (np.median(by_key[key]["abs_error_nm"][0]) for key in ("default_3", "none_3"))
    assert default < min(np.abs(found[0]["residual_nm"]).max() + 10, 0.6 * none)
    # Four magnitudes: between the square root of the flux, and the flux, which read noise alone would give.
    bright, dim = by_key["default_3"]["crb_nm"]
    assert 10**0.8 < dim / bright < 10**1.6


def test_curves_pool_the_errors_of_all_samples_and_the_floor_is_that_of_a_perfect_sensor(monkeypatch):
    errors = {0: [[1, 2], [30, np.nan]], 1: [[3, 4], [50, 40]]}

    def rows(star):
        for key in COMPARED:
            yield {
                "exposure_s": 0.1, "key": key, "magnitudes": np.array([9.0, 13.0]),
                "abs_error_nm": np.array(errors[star.seed[-1]], float), "crb_nm": np.array([1.0, 4.0]),
                "one_read_crb_nm": np.array([0.5, 1.0]),
                "residual_nm": (3.0 + star.seed[-1]) * np.array([1.0, -1.0]),
            }  # fmt: skip

    output = run_on(monkeypatch, faint, rows, samples=2, **ONE)
    found = tables_of(output)
    own = found["magnitudes"].query("key == 'default_3'")
    assert own.median_abs_error_nm.tolist() == [2.5, 40.0]
    assert (own.failures.tolist(), own.mag_j.tolist()) == ([0, 1], [9.0, 13.0])
    curve = found["curves"].set_index("key").loc["default_3"]
    assert (curve.trials, curve.modes) == (4, 3)
    assert curve.residual_floor_nm == pytest.approx(MEDIAN_OF_NORMAL * np.sqrt(12.5))
    figure, table = drawn(output, faint).blocks
    assert "this pipeline, 3 modes" in figure.svg and len(table.rows) == 6
