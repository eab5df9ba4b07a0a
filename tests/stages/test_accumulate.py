"""Raw frames summed to longer exposures. Truth: arithmetic on made-up counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.recording import Acquisition, CalibrationMaps, Detector
from irlos_pipe.readers.acquisition import Resolved
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.stages.ingest.sources import Source, accumulated

FRAMES = 20
ADU = np.random.default_rng(0).integers(190, 400, (FRAMES, 6, 7)).astype(np.uint16)


def source(adu: np.ndarray = ADU, counter=None, introduced_nm=0.0, **raw) -> Source:
    counter = np.arange(len(adu)) if counter is None else np.asarray(counter)
    recording = RawRecording(
        name="raw",
        path=Path("raw.fits"),
        layout="fits_cube",
        adu=adu,
        frame_counter=counter,
        unix_s=1e9 + 0.005 * counter,
        **raw,
    )
    detector = Detector(0.5, 1.0, background_e=0.1)
    told = Acquisition("psf", detector, ((1600.0, 1.0),), {}, 9.7, exposure_s=0.005, frame_rate_hz=200.0)
    defocus = np.broadcast_to(np.asarray(introduced_nm, float), (len(adu),)).copy()
    return Source("cube", recording, Resolved(told, defocus, ()))


def test_frames_are_summed_and_what_is_known_of_them_follows():
    dark = np.full((6, 7), 195.5)
    summed = accumulated(source(calibration=CalibrationMaps(dark_adu=dark, dark_variance_adu2=0.2)), 0.02)
    raw, told = summed.raw, summed.resolved.acquisition
    assert raw.adu.tolist() == ADU.reshape(5, 4, 6, 7).sum(axis=1).tolist()
    assert raw.frame_counter.tolist() == [0, 4, 8, 12, 16]
    assert raw.unix_s - 1e9 == pytest.approx([0, 0.02, 0.04, 0.06, 0.08], abs=1e-6)
    assert raw.calibration.dark_adu == pytest.approx(4 * dark)
    assert raw.calibration.dark_variance_adu2 == pytest.approx(16 * 0.2)
    assert (told.exposure_s, told.frame_rate_hz) == (pytest.approx(0.02), 50.0)
    detector = told.detector
    assert (detector.reads, detector.read_noise_e, detector.background_e) == (4, 2.0, pytest.approx(0.4))


def test_a_sum_without_one_of_its_frames_is_left_out():
    summed = accumulated(source(ADU[:19], counter=[*range(5), *range(6, 20)]), 0.02)
    assert summed.raw.frame_counter.tolist() == [0, 8, 12, 16]
    assert summed.raw.adu[1].tolist() == ADU[7:11].sum(axis=0).tolist()


def test_a_pixel_that_is_saturated_once_is_so_in_the_sum():
    adu = ADU.copy()
    adu[5, 2, 3] = 65535
    summed = accumulated(source(adu), 0.02)
    level = summed.resolved.acquisition.detector.saturation_adu
    assert level == 4 * 65535
    assert np.argwhere(summed.raw.adu >= level).tolist() == [[1, 2, 3]]


@pytest.mark.parametrize(
    ("exposure_s", "frames", "message"),
    [
        (0.0125, 20, r"frames of 0.005 s do not add up to accumulate_s = 0.0125 \(2.5 frames\)"),
        (0.2, 20, "no 40 of its 20 frames follow each other without a gap"),
    ],
)
def test_what_cannot_be_summed_is_refused_in_one_line(exposure_s, frames, message):
    with pytest.raises(InputDataError, match=message) as error:
        accumulated(source(ADU[:frames]), exposure_s)
    assert "\n" not in str(error.value)
