"""Reads as told in a side-car. Truth: arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.sparta_files import counts, star, write_recorder, write_sidecar

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.acquisition import resolve
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.sidecar import AcquisitionKeys

ADU = counts(star(16, 16), 4)


def acquisition(folder, *, exposure_s: float | None = 0.1, detector: dict | None = None, **keys):
    told = {"detector": {"e_per_adu": 0.5} | (detector or {}), **keys}
    write_recorder(folder / "rec", ADU)
    untold = ["exposure_s"] if exposure_s is None else []
    given = {} if exposure_s is None else {"exposure_s": exposure_s}
    write_sidecar(folder / "rec" / "acquisition.yaml", *untold, **told, **given)
    (raw,) = read_recordings(folder / "rec" / "rec.fits", load_instrument("irlos"))
    return resolve(raw, AcquisitionKeys(), load_instrument("irlos")).acquisition


def test_a_frame_has_as_many_reads_as_fill_its_exposure(tmp_path):
    detector = acquisition(tmp_path, detector={"read_s": 0.002, "read_noise_e": 0.8}).detector
    assert detector.reads == 50
    assert detector.read_noise_e == pytest.approx(0.8 * np.sqrt(50))


def test_the_read_noise_of_the_profile_is_that_of_one_of_its_reads(tmp_path):
    detector = acquisition(tmp_path).detector  # reads of 5 ms and 1 e-
    assert (detector.reads, detector.read_noise_e) == (20, pytest.approx(np.sqrt(20)))


def test_a_read_noise_that_is_told_without_reads_is_that_of_a_frame(tmp_path):
    detector = acquisition(tmp_path, detector={"read_noise_e": 2.5}).detector
    assert (detector.reads, detector.read_noise_e) == (1, 2.5)


def test_reads_make_the_exposure_where_none_is_told(tmp_path):
    told = acquisition(tmp_path, exposure_s=None, detector={"read_s": 0.004, "coadds": 250})
    assert told.exposure_s == pytest.approx(1.0)


def test_sky_and_dark_current_collect_during_the_exposure(tmp_path):
    told = acquisition(tmp_path, sky_e_per_s=14.0, detector={"dark_e_per_s": 3.0})
    assert told.detector.background_e == pytest.approx(1.7)


@pytest.mark.parametrize(
    ("detector", "message"),
    [
        ({"read_s": 0.005, "coadds": 10}, "detector.coadds = 10 reads of read_s = 0.005 s do not add up"),
        ({"read_s": 0.03}, r"reads of 0.03 s do not add up to exposure_s = 0.1 \(3.333 reads\)"),
    ],
)
def test_reads_that_do_not_add_up_to_the_exposure_are_refused_in_one_line(tmp_path, detector, message):
    with pytest.raises(InputDataError, match=message) as error:
        acquisition(tmp_path, detector=detector)
    assert "\n" not in str(error.value) and "acquisition.yaml" in str(error.value)
