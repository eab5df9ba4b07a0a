"""Contradictions between what was told and what frames show, on images drawn from the model."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import made_run
from helpers import optics_cases as cases

from irlos_pipe.frames.measured_noise import MeasuredNoise
from irlos_pipe.frames.recording import SIDECAR, Detector
from irlos_pipe.frames.told import cutoff_ratio, told_of
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf import PsfModel

FACILITY = load_instrument("irlos").facility
CUTOFF_PER_PX = 9.7e-3 / 206264.8 * 8.0 / 1600e-9
ZERO_POINT_E = 150_000 * 10 ** (0.4 * (15 - 7.0)) * 0.1  # of J = 7 in 0.1 s


@pytest.fixture(scope="module")
def mean_e() -> np.ndarray:
    """Mean of 50 frames of a star with 3e6 photons."""
    image = PsfModel(cases.settings(48), (4,)).images(torch.tensor([[40.0]]))[0].double().numpy()
    return np.random.default_rng(1).poisson(image * 1.5e8) / 50


def _recording(flux_e: float = 0.05 * ZERO_POINT_E, **keys):
    one = made_run.recording("sky", "calibration", 4)
    images = one.images_e * (flux_e / one.images_e[0].sum())
    told = {"mag_j": 7.0, "exposure_s": 0.1, "frame_rate_hz": 10.0} | keys
    acquisition = replace(one.acquisition, **told, sources=dict.fromkeys(told, SIDECAR))
    return replace(one, images_e=images, acquisition=acquisition)


def _found(recording, noise: MeasuredNoise | None = None, step_s: float = 0.1) -> tuple[set[str], set[str]]:
    """Names of what is warned of, and of what is wrong beyond doubt."""
    told = told_of(recording, noise or MeasuredNoise(), FACILITY, step_s)
    return {one.name for one in told if one.warned}, {one.name for one in told if one.wrong}


def test_what_is_told_rightly_is_not_doubted():
    assert _found(_recording()) == (set(), set())


def test_photon_transfer_contradicts_a_gain_four_times_off_but_not_within_its_error():
    recording = replace(
        _recording(), acquisition=replace(_recording().acquisition, detector=Detector(2.0, 1.0))
    )
    assert "photon noise" in _found(recording, MeasuredNoise(1.0, 0.1, 0.01, 0.001))[1]
    assert "photon noise" not in _found(recording, MeasuredNoise(1.0, 0.1, 9.0, 2.0))[1]


@pytest.mark.parametrize(
    "keys", [{"diversity": {6: -0.17}}, {"diversity": {1000: -170.0}}, {"pixel_scale_mas": 0.0097}]
)
def test_implausible_values_are_worth_a_warning(keys):
    assert _found(_recording(**keys))[0]


def test_the_image_ends_at_the_cut_off_of_the_telescope(mean_e):
    good = np.ones(mean_e.shape, bool)
    assert 0.75 < cutoff_ratio(mean_e, good, CUTOFF_PER_PX) < 1.1
    assert cutoff_ratio(mean_e, good, CUTOFF_PER_PX / 1.5) > 1.25  # scale told too small by a third
    smear = 2 / len(mean_e) / (1.5 * CUTOFF_PER_PX)  # of the taper, half the width of its main lobe
    assert cutoff_ratio(mean_e, good, CUTOFF_PER_PX * 1.5) == pytest.approx(1 / 1.5, abs=smear)
    assert np.isnan(
        cutoff_ratio(mean_e / 1e6 + np.random.default_rng(2).normal(size=mean_e.shape), good, 0.2)
    )
