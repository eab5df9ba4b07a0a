"""A deformable mirror in the simulator.

Truth: formulas of the Zernike polynomials, turned and shifted by hand.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import optics_cases as cases

from irlos_pipe.conventions import bands
from irlos_pipe.simulate import SceneError
from irlos_pipe.simulate.exposure import expose, telescope_of
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.mirror import Actuators, Mirror
from irlos_pipe.simulate.scene import Scene

FINE = Mirror(Actuators(cases.FACILITY.pupil.diameter_m, 0.25))
SMOOTH = Mirror(replace(FINE.actuators, coupling=0.7))  # makes modes to a few parts in a thousand
SCENE = Scene("mirror", cases.FACILITY, (Band(bands.NARROW_H.centre_nm, 20.0),), (1,), 1, 0.1)
TELESCOPE = telescope_of(SCENE)


def coefficients_nm(mirror: Mirror) -> np.ndarray:
    """Noll 2.. of what the mirror makes, fitted over the pupil."""
    return TELESCOPE.fit_zernike_nm(mirror.opd_nm(TELESCOPE), 45)


def test_an_aligned_mirror_makes_the_modes_that_it_is_sent():
    sent_nm = {4: 100.0, 7: -40.0, 22: 20.0}
    left_nm = replace(FINE, offsets_nm=sent_nm).opd_nm(TELESCOPE) - TELESCOPE.opd_nm(sent_nm)
    lit = TELESCOPE.transmission > 0
    assert left_nm[lit].std() < 0.02 * np.linalg.norm(list(sent_nm.values()))


def test_few_actuators_make_fine_modes_badly_and_coarse_ones_well():
    few = Mirror(Actuators(8.0, 1.0))
    lit = TELESCOPE.transmission > 0
    errors = {
        noll: (replace(few, offsets_nm={noll: 1.0}).opd_nm(TELESCOPE) - TELESCOPE.mode(noll))[lit].std()
        for noll in (4, 30)
    }
    assert errors[30] > 5 * errors[4]
    assert 50 < few.actuators.present.sum() < 100


def test_a_gain_scales_the_wavefront():
    sent = replace(FINE, offsets_nm={4: 100.0, 30: 10.0})
    expected = 0.9 * sent.opd_nm(TELESCOPE)
    assert replace(sent, gain=0.9).opd_nm(TELESCOPE) == pytest.approx(expected)


def test_a_turned_mirror_turns_its_modes_anticlockwise():
    # cos 2(θ − α) = cos 2α cos 2θ + sin 2α sin 2θ: Noll 6 is the cosine, Noll 5 the sine.
    found_nm = coefficients_nm(replace(FINE, turn_deg=10.0, offsets_nm={6: 100.0}))
    angle = np.deg2rad(20.0)
    assert found_nm[[6 - 2, 5 - 2]] == pytest.approx([100 * np.cos(angle), 100 * np.sin(angle)], abs=1.0)


def test_a_shifted_mirror_makes_tilt_of_defocus():
    # √3 (2 ((x − s)² + y²) − 1) = Z4 − 2 √3 s · 2x + constant, s in radii of the pupil.
    shift_m = 0.02 * FINE.actuators.diameter_m / 2
    found_nm = coefficients_nm(replace(SMOOTH, shift_m=(shift_m, -2 * shift_m), offsets_nm={4: 100.0}))
    slope_nm = 100 * 2 * np.sqrt(3) * 0.02
    assert found_nm[:3] == pytest.approx([-slope_nm, 2 * slope_nm, 100.0], abs=0.5)


def test_minus_the_aberration_on_the_mirror_gives_the_image_of_a_perfect_star():
    perfect, aberrated = expose(SCENE), replace(SCENE, ncpa_nm={4: 150.0, 8: -60.0})
    corrected = expose(replace(aberrated, mirror=replace(FINE, offsets_nm={4: -150.0, 8: 60.0})))
    worse = expose(replace(aberrated, mirror=FINE))
    peak = float(perfect.mean_e.max())
    assert corrected.mean_e == pytest.approx(perfect.mean_e, abs=0.002 * peak)
    assert worse.mean_e.max() < 0.8 * peak
    assert worse.mean_zernike_nm()[4] == pytest.approx(150.0, abs=1e-6)  # a mirror at rest is flat
    assert abs(corrected.mean_zernike_nm()[4]) < 1.0


def test_offsets_that_the_mirror_does_not_take_are_refused():
    with pytest.raises(SceneError, match="no offsets of Noll 31"):
        Mirror(FINE.actuators, offsets_nm={31: 1.0})
