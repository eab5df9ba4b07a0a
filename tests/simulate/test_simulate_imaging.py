"""Static images of the simulator.

Truth: HCIPy on a pupil grid three to six times finer (independent code, `reference_psf`); the Airy
pattern integrated over pixels by scipy; HCIPy's Zernikes; symmetry and energy.
"""

import numpy as np
import pytest
from helpers.reference_psf import hcipy, reference
from helpers.simulated_scenes import MAS_RAD, NCPA_NM, image, scene, tilt_nm_rms, worst
from scipy.integrate import dblquad
from scipy.special import j1

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.exposure import expose, exposures
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.scene import Sampling
from irlos_pipe.simulate.telescope import zernike

DISC = PupilGeometry(8.0)
SAMPLES = 768  # of HCIPy's pupil; those of the simulator are 256 and 128
TOTAL_NM = {**NCPA_NM, 6: NCPA_NM[6] - 170.0}


@pytest.mark.slow
@pytest.mark.parametrize(("wavelength_nm", "window"), [(1200.0, (64, 64)), (1600.0, (33, 48))])
def test_static_images_agree_with_hcipy(wavelength_nm, window):
    found = image(bands=(Band(wavelength_nm, 1e-6),), window=window)
    assert worst(found, reference(SAMPLES).image(TOTAL_NM, wavelength_nm, window, 9.7)) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("wavelength_nm", "window"), [(1200.0, (64, 64)), (1600.0, (33, 48))])
def test_the_coarser_sampling_of_sky_scenes_is_as_good(wavelength_nm, window):
    calm = {"sky": Sky(1e-4, wfe_nm=0.1), "motion": Motion(rms_mas=0.0), "window": window}
    assert scene(**calm).pupil_samples < scene().pupil_samples
    found = image(bands=(Band(wavelength_nm, 1e-6),), **calm)
    assert worst(found, reference(SAMPLES).image(TOTAL_NM, wavelength_nm, window, 9.7)) < 1e-4


@pytest.mark.slow
def test_a_band_is_the_weighted_sum_of_its_wavelengths():
    bands = (Band(1215.0, 58.0, 0.5), Band(1625.0, 84.0, 0.5))
    nodes, weights = np.polynomial.legendre.leggauss(3)
    points = [
        (band.centre_nm + node * band.half_width_nm, weight / 2 * band.share)
        for band in bands
        for node, weight in zip(nodes, weights, strict=True)
    ]
    expected = sum(part * reference(SAMPLES).image(TOTAL_NM, nm, (48, 48), 9.7) for nm, part in points)
    assert worst(image(bands=bands, sampling=Sampling(points_per_band=3)), expected) < 1e-4


def test_an_unobscured_disc_gives_the_airy_pattern_with_all_its_energy():
    found = image(geometry=DISC, ncpa_nm={}, diversity_nm={}, window=(9, 9))
    per_px = 9.7 * MAS_RAD * np.pi * 8.0 / 1.6e-6

    def airy(y_px: float, x_px: float) -> float:
        x = max(np.hypot(x_px, y_px) * per_px, 1e-9)
        return (2 * j1(x) / x) ** 2 * per_px**2 / (4 * np.pi)  # integral over the plane: 1

    expected = [dblquad(airy, x - 0.5, x + 0.5, -0.5, 0.5, epsabs=1e-9)[0] for x in range(-4, 5)]
    assert np.allclose(found[4], expected, atol=2e-5 * max(expected))


@pytest.mark.parametrize("window", [(31, 31), (32, 32), (20, 33)])
def test_the_optical_axis_lies_at_the_middle_of_even_and_odd_windows(window):
    found = image(geometry=DISC, ncpa_nm={}, diversity_nm={}, window=window)
    assert np.allclose(found, found[::-1, ::-1], atol=1e-12)
    assert np.allclose(found.sum(axis=0) @ np.arange(window[1]) / found.sum(), (window[1] - 1) / 2)


@pytest.mark.parametrize(("noll", "axis"), [(2, 1), (3, 0)])
def test_positive_tilts_move_the_image_to_larger_columns_and_rows(noll, axis):
    moved = image(ncpa_nm={noll: tilt_nm_rms(3 * 9.7)})
    assert worst(np.roll(moved, -3, axis=axis)[4:-4, 4:-4], image(ncpa_nm={})[4:-4, 4:-4]) < 1e-9


@pytest.mark.slow
def test_photons_follow_magnitude_exposure_and_throughput():
    faint = scene(mag_j=12.0, exposure_s=2.0, throughput=0.3, frame_rate_hz=0.5)
    assert np.isclose(faint.photons, 150_000 * 10**1.2 * 2 * 0.3)
    electrons = next(exposures(faint)).mean_e.sum()
    in_window = reference(SAMPLES).image(TOTAL_NM, 1600.0, (48, 48), 9.7).sum()
    assert np.isclose(electrons, faint.photons * in_window, rtol=1e-4)


def test_zernikes_agree_with_hcipy():
    grid = hcipy.make_pupil_grid(32, 2.0)  # no point at 0, where HCIPy divides by it
    for noll in (1, 2, 3, 4, 5, 6, 7, 10, 22, 37, 66):
        order = hcipy.noll_to_zernike(noll)
        expected = hcipy.zernike(*order, D=2.0, grid=grid, radial_cutoff=False)
        assert np.allclose(zernike(noll, grid.x, grid.y), expected, atol=1e-10), noll


def test_the_rotating_part_turns_with_the_derotator():
    parts = {"ncpa_nm": {7: 30.0}, "rotating_nm": {2: 50.0, 5: 20.0}}
    found = expose(scene(**parts, derotator_angle_deg=90.0)).mean_zernike_nm()
    expected = {3: 50.0, 5: -20.0, 7: 30.0}
    assert all(np.isclose(value, expected.get(noll, 0.0), atol=1e-6) for noll, value in found.items())


def test_the_truth_leaves_out_diversity_and_introduced_defocus():
    exposed = expose(scene(frames=2, introduced_nm=(100.0, -250.0)))
    fitted = dict(enumerate(exposed.telescope.fit_zernike_nm(exposed.mean_opd_nm, 52), start=2))
    for found in (fitted, exposed.mean_zernike_nm()):
        assert all(np.isclose(found[noll], NCPA_NM.get(noll, 0.0), atol=1e-6) for noll in found)
    assert np.allclose(exposed.zernike_nm, exposed.zernike_nm[0])
    assert worst(exposed.mean_e[0], exposed.mean_e[1]) > 0.1
