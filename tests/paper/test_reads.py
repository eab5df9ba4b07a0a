"""Exposures of many reads. Truth: the simulator's own sum of single reads, Monte Carlo; counting by hand."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import optics_cases as cases
from scipy import stats

from irlos_pipe.paper.common.observation import Read, as_read, noise_of, recorded_e
from irlos_pipe.paper.common.scenes import star_scene
from irlos_pipe.simulate.readout import electrons

READ = Read(0.05, 2.0, 1.4, 30.0)  # twenty in a second
LIGHT_E, FRAMES = 40.0, 20000


def scene():
    star = star_scene("test", cases.FACILITY, (1,), 1, 12.0, {}, seeing_arcsec=0.5)
    skies = replace(cases.FACILITY, sky_mag_per_arcsec2=((1215.0, 16.5), (1625.0, 14.4)))
    return replace(star, facility=skies, window=(1, 1), detector=replace(star.detector, e_per_adu=1e9))


@pytest.mark.slow
def test_the_exposure_has_the_statistics_of_all_its_reads():
    """Two samples of 20 000 exposures: one noisy read, and the sum of twenty that the simulator draws."""
    at_once = as_read(scene(), READ)
    singly = replace(
        at_once, detector=replace(at_once.detector, read_s=READ.exposure_s, read_noise_e=READ.noise_e)
    )
    mean_e = np.full((FRAMES, 1, 1), LIGHT_E)
    one, many = (
        electrons(s, mean_e, np.random.default_rng(i)).ravel() for i, s in ((1, at_once), (2, singly))
    )
    assert stats.ks_2samp(one, many).pvalue > 0.01
    assert one.var() == pytest.approx(many.var(), rel=0.04)  # 4 sigma


@pytest.mark.slow
def test_frames_have_the_noise_that_their_model_states_about_the_light_of_the_star():
    """V = F (star + sky + dark) + N sigma^2 by the scatter of 20 000 exposures; the mean sky is taken off."""
    read = as_read(scene(), READ)
    frames = recorded_e(read, np.full((FRAMES, 1, 1), LIGHT_E), np.random.default_rng(3))
    charge = LIGHT_E + read.sky_e_per_s + READ.dark_e_per_s
    expected = READ.excess_noise_factor * charge + 20 * READ.noise_e**2
    assert read.sky_e_per_s > 0
    assert noise_of(read).variance_e2(LIGHT_E) == pytest.approx(expected)
    assert frames.var() == pytest.approx(expected, rel=0.04)
    assert frames.mean() == pytest.approx(LIGHT_E, abs=4 * np.sqrt(expected / FRAMES))
