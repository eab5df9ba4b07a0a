"""The adaptive optics that is simulated end to end measures and corrects what it should."""

import numpy as np
import pytest
from simulator import closed_loop
from simulator.closed_loop import LOOP_S, SUBAPERTURE_M, ClosedLoop
from simulator.telescope import build_telescope

pytestmark = pytest.mark.slow
HEIGHT_M = 11_000.0  # of a layer


@pytest.fixture(scope="module")
def telescope():
    return build_telescope(240, 2)


def test_the_cone_of_the_laser_star_magnifies_high_layers():
    hardware = closed_loop.build_hardware()
    # The laser star sees the layer at r (1 - h / H) in r: slopes are smaller by that factor.
    y_m = closed_loop.centres(len(hardware.lit), SUBAPERTURE_M / closed_loop.SAMPLES_PER_SUBAPERTURE)
    opd_nm = np.repeat(30.0 * y_m[:, None], len(y_m), axis=1)
    along_x, along_y = hardware.slopes(opd_nm, HEIGHT_M)
    assert np.allclose(along_y, 30.0 * (1 - HEIGHT_M / closed_loop.LASER_STAR_M))
    assert np.allclose(along_x, 0)


def test_the_loop_follows_a_wavefront_that_stands_still(monkeypatch, telescope):
    # An integrator leaves nothing of a shape that its mirror can make, but for its leak.
    static_nm = closed_loop.build_hardware().mirror_nm(
        50 * np.random.default_rng(2).standard_normal(closed_loop.build_hardware().actuators)
    )
    ground = iter(range(10**6))
    monkeypatch.setattr(
        closed_loop, "opd_at", lambda layer, time_s: static_nm if next(ground) % 4 == 0 else 0 * static_nm
    )
    monkeypatch.setattr(closed_loop, "SLOPE_NOISE_NM", 0.0)
    monkeypatch.setattr(closed_loop, "WARM_UP_S", 0.2)
    loop = ClosedLoop(telescope, 0.5, 0.01, np.random.default_rng(1))
    lit = telescope.transmission > 0.99
    left_nm = loop.next_nm()[lit]
    before_nm = (loop.to_pupil @ static_nm @ loop.to_pupil.T)[lit]
    assert np.std(left_nm) < 0.15 * np.std(before_nm)


def test_turbulence_is_corrected_and_drawn_from_the_seed(monkeypatch, telescope):
    monkeypatch.setattr(closed_loop, "WARM_UP_S", 0.05)
    first, again, other = (
        ClosedLoop(telescope, 0.5, 2 * LOOP_S, np.random.default_rng(seed)).next_nm() for seed in (1, 1, 2)
    )
    lit = telescope.transmission > 0.5
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)
    # Without correction the wavefront has sqrt(1.03 (D / r0)^(5/3)) rad at 500 nm with r0 = 0.2 m, 1.7 um.
    assert 60 < np.std(first[lit]) < 300
