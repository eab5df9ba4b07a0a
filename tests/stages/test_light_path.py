"""What the stages refuse before a model is built. Truth: the geometry of the instrument."""

from dataclasses import replace

import numpy as np
import pytest

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.frames.recording import Acquisition, Detector, Recording
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.stages.model.recording_settings import psf_settings, residual_band, seeing_arcsec
from irlos_pipe.stages.model.section import ModelConfig

IRLOS = load_instrument("irlos")


def recording(window: int = 64, **changes) -> Recording:
    spectrum, diversity = ((1600.0, 1.0),), {6: -170.0}
    acquisition = Acquisition("ncpa_calibration", Detector(1.0, 1.0), spectrum, diversity, 9.7, **changes)
    images = np.zeros((1, window, window), np.float32)
    used, mask = np.ones(1, bool), np.ones((window, window), bool)
    per_frame = np.zeros(1), np.zeros(1, int), np.zeros(1)
    return Recording("cube", "calibration", images, used, np.array([""]), mask, *per_frame, acquisition)


def test_the_residual_band_and_a_missing_seeing_are_those_of_the_instrument():
    facility = replace(IRLOS.facility, cutoff_per_m=9.0, outer_scale_m=30.0, typical_seeing_arcsec=0.7)
    own = replace(IRLOS, facility=facility)
    assert residual_band(own, ModelConfig()) == ResidualBand(1 / 8, 9.0, 30.0)
    assert residual_band(own, ModelConfig(cutoff_per_m=6.0)) == ResidualBand(1 / 8, 6.0, 30.0)
    assert seeing_arcsec(own, recording().acquisition) == 0.7


def test_a_window_wider_than_the_sampled_pupil_supports_is_an_error_of_the_recipe():
    with pytest.raises(ConfigurationError, match=r"model\.pupil_samples 48.*times as many"):
        psf_settings(IRLOS, ModelConfig(pupil_samples=48), recording(window=400))
