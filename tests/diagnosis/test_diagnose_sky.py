"""A model without the AO residual on frames that have one: the simulator shares no optics with the fit.

Truth: the wavefront that the simulator averaged over the frames.
"""

import functools

import numpy as np
import pytest
from helpers.optics_cases import BAND, DIVERSITY, NCPA_LAW, RESIDUAL_LAW
from helpers.simulated_scenes import NARROW_H, NCPA_NM, UT4, sky_frames

from irlos_pipe.diagnosis.records import Options
from irlos_pipe.diagnosis.verdict import Diagnosis
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import Conditions
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.simulate.atmosphere import Sky

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("on_sky")]  # its diagnosis serves all tests
WINDOW, FRAMES, HIGHEST_NOLL, SEEING_ARCSEC = (40, 40), 48, 36, 0.6


@functools.cache
def on_sky() -> tuple[Diagnosis, dict[int, float]]:
    """Diagnosis of a model without any effect, and the true wavefront."""
    ncpa_nm = {noll: value for noll, value in NCPA_NM.items() if noll <= HIGHEST_NOLL}
    taken = {"window": WINDOW, "frames": FRAMES, "seed": (4, 1), "ncpa_nm": ncpa_nm, "throughput": 0.02}
    frames, exposed = sky_frames(Sky(SEEING_ARCSEC), **taken)
    spectrum = tuple((band.centre_nm, 1.0) for band in NARROW_H)
    settings = PsfSettings(UT4, WINDOW, 9.7, spectrum, KnownWavefront(DIVERSITY))
    conditions = Conditions(settings, BAND, RESIDUAL_LAW, SEEING_ARCSEC, HIGHEST_NOLL, ncpa_law=NCPA_LAW)
    options = Options(HIGHEST_NOLL, held_out=0.25, most_names=1, sure=5.0)
    return diagnose([Exposures(frames, conditions)], [], options), exposed.mean_zernike_nm()


def error_nm(modes_nm: np.ndarray, nolls: tuple[int, ...]) -> float:
    """Error of Noll 4 to 30."""
    true = on_sky()[1]
    return float(np.sqrt(sum((modes_nm[nolls.index(n)] - true[n]) ** 2 for n in range(4, 31))))


def test_the_ao_residual_is_what_an_on_sky_model_without_it_lacks_first():
    diagnosis, _ = on_sky()
    assert diagnosis.verdict == "effect"
    assert diagnosis.steps[0].name == "seeing_halo"
    assert diagnosis.steps[0].explained > 0.9


def test_the_ncpa_error_falls_several_times_with_the_residual_in_the_model():
    diagnosis, _ = on_sky()
    before, after = (error_nm(modes_nm, diagnosis.nolls) for modes_nm in diagnosis.modes_nm)
    assert after < before / 3


def test_without_the_residual_the_fit_still_ends_beside_the_truth_and_not_at_its_twin():
    """The twin has Noll 6 at twice the diversity, some 340 nm away."""
    diagnosis, _ = on_sky()
    assert error_nm(diagnosis.modes_nm[0], diagnosis.nolls) < 100
