"""The derotator test on simulated cubes. Truth: the simulator, which turns wavefronts by its own code, the
height of the bump, and made-up estimates with errors of known size."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.experiment_stage import drawn, run_on, sample, tables_of

from irlos_pipe.estimate.derotator import Series, split_series, usable_modes
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.zernike import zernike_basis
from irlos_pipe.paper import derotator_series
from irlos_pipe.paper.derotator_series import (
    draw_truth,
    phase_bump_nm,
    ridge_nm,
    rms_beyond_tilt_nm,
    split_errors,
)
from irlos_pipe.simulate.exposure import expose

pytestmark = pytest.mark.slow
FACILITY = load_instrument("irlos").facility
TRUTH = draw_truth((5,), FACILITY.ncpa_law, 30.0, 60.0)
SIZES = {"frames": 24, "published_frames": 3}
STAR = sample(derotator_series, (5, 1), FACILITY, SIZES, angle_deg=46.0, sparta_arcsec=0.5, truth=TRUTH)
ERROR_NM = {"long_exposure": 1.0, "dip_global": 20.0}


def random_points(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    radius, azimuth = np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * np.pi, count)
    return radius * np.cos(azimuth), radius * np.sin(azimuth)


def test_the_bump_is_the_ridge_but_for_piston_tip_and_tilt():
    x, y = random_points()
    bump = phase_bump_nm()
    modes = zernike_basis(range(1, 4), x, y)
    rest = ridge_nm(x, y) - np.array(list(bump.values())) @ zernike_basis(list(bump), x, y)
    left = rest - np.linalg.lstsq(modes.T, rest, rcond=None)[0] @ modes
    assert np.sqrt(np.mean(left**2)) < 6
    assert rms_beyond_tilt_nm(bump) == pytest.approx(186, abs=1)
    beyond = {noll: value for noll, value in bump.items() if noll > 30}
    assert rms_beyond_tilt_nm(beyond) == pytest.approx(62, abs=1)


def test_the_truth_at_an_angle_is_what_the_simulator_makes():
    scene = replace(derotator_series.scene_of(STAR), sky=None, motion=None, frames=1)
    exposed = expose(scene)
    lit = exposed.transmission > 0.5
    nolls = sorted({*TRUTH.rotating_nm, *TRUTH.fixed_nm})
    centres = (np.arange(len(lit)) - (len(lit) - 1) / 2) * 2 / len(lit)
    x, y = np.meshgrid(centres, centres)
    expected = TRUTH.at(nolls, 46.0) @ zernike_basis(nolls, x[lit], y[lit])
    assert np.abs(exposed.mean_opd_nm[lit] - expected).max() < 1e-2


def test_a_perfect_series_leaves_only_what_was_not_estimated():
    """Estimates without error of 29 modes."""
    nolls, angles = tuple(range(4, 31)), np.array([0.0, 40.0, 110.0])
    static = np.array([TRUTH.at(nolls, angle) for angle in angles])
    perfect = Series(nolls, angles, static, np.broadcast_to(np.eye(27), (3, 27, 27)))
    errors = split_errors(perfect, split_series(perfect, 1), TRUTH)
    assert max(errors[f"{name}_error_nm"] for name in ("rotating", "fixed", "unsplit", "model")) < 1e-9
    symmetric = (37, 56, 79, 106)
    missed = {noll: one for noll, one in TRUTH.rotating_nm.items() if noll > 30 and noll not in symmetric}
    assert errors["rotating_all_error_nm"] == pytest.approx(rms_beyond_tilt_nm(missed))


def test_both_methods_estimate_the_cube_and_the_default_errs_less():
    default, published = derotator_series.rows(STAR)
    assert usable_modes(tuple(published["nolls"]))[2:].all()
    assert (default["frames"], published["frames"]) == (24, 3)
    assert default["delta_nm"] < min(30, 0.6 * published["delta_nm"])
    assert default["covariance_nm2"].shape == (65, 65)


def angle_estimates(star):
    """The static wavefront with noise of known size."""
    rng = np.random.default_rng(star.seed)
    for method, error in ERROR_NM.items():
        nolls = np.arange(2, 67 if method == "long_exposure" else 31)
        estimate_nm = star["truth"].at(nolls, star["angle_deg"]) + error * rng.normal(size=len(nolls))
        yield {
            "method": method,
            "frames": 9,
            "delta_nm": error * 29**0.5,
            "chi2_nu": 1.0,
            "nolls": nolls,
            "zernike_nm": estimate_nm,
            "covariance_nm2": error**2 * np.eye(len(nolls)),
            "mean_image_e": np.ones((8, 8)),
        }


def test_parts_of_a_series_err_as_their_estimates_do_and_are_drawn(monkeypatch):
    output = run_on(monkeypatch, derotator_series, angle_estimates)
    for row in tables_of(output)["methods"].itertuples():
        # 24 separable modes of Noll 4–30, each part's variance at least that of a mean of nine.
        expected = ERROR_NM[row.method] * np.sqrt(24 / 9)
        assert expected / 2 < row.rotating_error_nm < 2 * expected
        assert expected / 2 < row.fixed_error_nm < 2 * expected
        assert row.model_error_nm < row.single_error_nm
        assert 0.8 < row.chi2_nu < 1.2
        assert (row.sense, row.delta_chi2 > 100) == ("anticlockwise", True)
    blocks = drawn(output, derotator_series).blocks
    assert {"What turns with the derotator", "What does not turn"} <= {block.title for block in blocks}
    assert [row[0] for row in blocks[-1].rows][:2] == ["0°", "23°"]
