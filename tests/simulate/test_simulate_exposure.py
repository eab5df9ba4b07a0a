"""How the simulator hands out frames: repeatable, one by one, independent of how many there are.

Truth: repetition, and finer sampling in time and wavelength.
"""

import tracemalloc

import numpy as np
import pytest
from helpers.simulated_scenes import image, scene, worst

from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.exposure import expose, exposures
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.scene import Sampling

QUICK = {
    "sky": Sky(0.5),
    "motion": Motion(),
    "window": (24, 24),
    "frames": 3,
    "exposure_s": 0.04,
    "sampling": Sampling(pupil_samples=48, points_per_band=1),
}


BENCH = QUICK | {"sky": None, "motion": None}


def test_modes_of_the_truth_are_those_of_the_scene_whatever_lies_beyond_them():
    """Over an obscured pupil Noll 37 looks like spherical aberration, of which this scene has none."""
    ncpa_nm = {5: 20.0, 37: 60.0, 56: 40.0}
    exposed = expose(scene(**BENCH, ncpa_nm=ncpa_nm))
    stated_nm = [20.0 if noll == 5 else 0.0 for noll in range(2, 32)]
    assert exposed.zernike_nm == pytest.approx(np.tile(stated_nm, (3, 1)), abs=1e-6)
    assert list(exposed.mean_zernike_nm().values()) == pytest.approx(stated_nm, abs=1e-6)
    fitted_nm = exposed.telescope.fit_zernike_nm(exposed.mean_opd_nm, 31)
    assert abs(fitted_nm[11 - 2]) > 1.0  # of the same wavefront, had the scene not stated its modes


def test_the_same_seed_gives_the_same_bits_and_another_one_another_sky():
    first, second, other = (expose(scene(**QUICK, **seed)) for seed in ({}, {}, {"seed": (20, 25)}))
    assert np.array_equal(first.mean_e, second.mean_e)
    assert np.array_equal(first.mean_opd_nm, second.mean_opd_nm)
    assert np.abs(first.zernike_nm - other.zernike_nm).max() > 1


def test_sky_and_motion_are_drawn_apart():
    with_motion, without = expose(scene(**QUICK)), expose(scene(**QUICK | {"motion": None}))
    assert np.allclose(with_motion.zernike_nm[:, 2:], without.zernike_nm[:, 2:], atol=1e-3)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_frames():
    def peak_bytes(frames: int) -> int:
        tracemalloc.start()
        for _ in exposures(scene(**QUICK | {"frames": frames})):
            pass
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    peak_bytes(2)  # fills the caches
    assert peak_bytes(40) < 1.02 * peak_bytes(4)


@pytest.mark.slow
def test_the_default_step_makes_frames_scatter_hardly_more_than_continuous_exposure():
    def scatter_nm(step_s: float) -> float:
        sampling = Sampling(pupil_samples=32, points_per_band=1, step_s=step_s)
        cube = expose(scene(sky=Sky(0.5), frames=120, window=(4, 4), sampling=sampling))
        return float(np.sqrt(cube.zernike_nm[:, 2:].var(axis=0).mean()))

    assert 1.0 < scatter_nm(Sampling().step_s) / scatter_nm(0.002) < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("band", [Band(1600.0, 20.0), Band(1215.0, 58.0), Band(1625.0, 84.0)])
def test_the_default_wavelengths_resolve_the_bands(band):
    few, many = (
        image(bands=(band,), window=(64, 64), sampling=Sampling(points_per_band=points))
        for points in (Sampling().points_per_band, 15)
    )
    assert worst(few, many) < 1e-5
