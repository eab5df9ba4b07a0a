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
