"""The derotator test on simulated cubes. Truth: the simulator, which turns wavefronts by its own code, and
the height of the bump."""

from dataclasses import replace

import numpy as np
import pytest

from irlos_pipe.estimate.derotator import Series, split_series, usable_modes
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.zernike import zernike_basis
from irlos_pipe.paper.common.phase_bump import phase_bump_nm, ridge_nm
from irlos_pipe.paper.derotator_series.experiment import (
    AngleSample,
    Truth,
    draw_truth,
    estimate,
    rms_beyond_tilt_nm,
    split_errors,
)
from irlos_pipe.simulate.exposure import expose

FACILITY = load_instrument("irlos").facility
TRUTH = draw_truth((5,), FACILITY.ncpa_law, 30.0, 60.0)


def sample(**changes) -> AngleSample:
    values = {
        "name": "a",
        "seed": (5, 1),
        "facility": FACILITY,
        "truth": TRUTH,
        "angle_deg": 46.0,
        "frames": {"long_exposure": 24, "dip_global": 3},
        "seeing_arcsec": 0.5,
        "mag_j": 8.0,
    }
    return AngleSample(**values | changes)


def random_points(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    radius, azimuth = np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * np.pi, count)
    return radius * np.cos(azimuth), radius * np.sin(azimuth)


@pytest.mark.slow
def test_the_bump_is_the_ridge_but_for_piston_tip_and_tilt():
    x, y = random_points()
    bump = phase_bump_nm()
    modes = zernike_basis(range(1, 4), x, y)
    rest = ridge_nm(x, y) - np.array(list(bump.values())) @ zernike_basis(list(bump), x, y)
    left = rest - np.linalg.lstsq(modes.T, rest, rcond=None)[0] @ modes
    assert np.sqrt(np.mean(left**2)) < 6
    assert rms_beyond_tilt_nm(bump) == pytest.approx(186, abs=1)


@pytest.mark.slow
def test_a_good_part_of_the_bump_lies_beyond_the_29_modes():
    beyond = {noll: value for noll, value in phase_bump_nm().items() if noll > 30}
    assert rms_beyond_tilt_nm(beyond) == pytest.approx(62, abs=1)


@pytest.mark.slow
def test_the_truth_at_an_angle_is_what_the_simulator_makes():
    scene = replace(sample().scene(), sky=None, motion=None, frames=1)
    exposed = expose(scene)
    lit = exposed.transmission > 0.5
    nolls = sorted({*TRUTH.rotating_nm, *TRUTH.fixed_nm})
    centres = (np.arange(len(lit)) - (len(lit) - 1) / 2) * 2 / len(lit)
    x, y = np.meshgrid(centres, centres)
    expected = TRUTH.at(nolls, 46.0) @ zernike_basis(nolls, x[lit], y[lit])
    assert np.abs(exposed.mean_opd_nm[lit] - expected).max() < 1e-2


@pytest.fixture(scope="module")
def perfect() -> Series:
    """Estimates without error of 29 modes."""
    nolls, angles = tuple(range(4, 31)), np.array([0.0, 40.0, 110.0])
    static = np.array([TRUTH.at(nolls, angle) for angle in angles])
    return Series(nolls, angles, static, np.broadcast_to(np.eye(27), (3, 27, 27)))


def test_a_perfect_series_leaves_only_what_was_not_estimated(perfect):
    errors = split_errors(perfect, split_series(perfect, 1), TRUTH)
    assert max(errors.rotating_nm, errors.fixed_nm, errors.unsplit_nm, errors.model_nm) < 1e-9
    missed = {
        noll: value
        for noll, value in TRUTH.rotating_nm.items()
        if noll > 30 and noll not in (37, 56, 79, 106)
    }
    assert errors.rotating_all_nm == pytest.approx(rms_beyond_tilt_nm(missed))


def test_a_wrong_truth_shows_by_its_size(perfect):
    wrong = Truth(TRUTH.rotating_nm, {**TRUTH.fixed_nm, 5: TRUTH.fixed_nm[5] + 7.0})
    errors = split_errors(perfect, split_series(perfect, 1), wrong)
    assert errors.fixed_nm == pytest.approx(7.0)
    assert errors.single_nm == pytest.approx(7.0)
    assert errors.rotating_nm < 1e-9


@pytest.mark.slow
def test_both_methods_estimate_the_cube_and_the_default_errs_less():
    found = estimate(sample())
    assert usable_modes(tuple(found["dip_global/noll"]))[2:].all()
    assert found["long_exposure/delta_nm"] < 30
    assert found["long_exposure/delta_nm"] < 0.6 * found["dip_global/delta_nm"]
    assert found["mean_image_e"].shape == (64, 64)
    assert found["long_exposure/covariance_nm2"].shape == (65, 65)
