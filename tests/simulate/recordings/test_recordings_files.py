"""Files of simulated recordings, read back with the readers of ingest, astropy and PyYAML.

Truth: the frames handed to the writer, and the definition of the layouts in FITS.
"""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from helpers.simulation_specs import CUBE, planned

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.acquisition import resolve
from irlos_pipe.readers.find import read_recordings, recording_files
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.recordings.files import Planned, write_files


def night(folder: Path, **recording) -> Planned:
    return planned(folder, {"night": CUBE | recording}, sky={"seeing_arcsec": 0.7})["night"]


def frames_of(one: Planned, frames: int | None = None):
    """Raw frames that use the whole range of the converter, one by one."""
    rng = np.random.default_rng(0)
    for _ in range(frames or one.scene.frames):
        yield rng.integers(0, 65536, one.scene.window).astype(np.uint16)


def write(one: Planned, folder: Path) -> Path:
    """Write a recording of random frames; returns its folder."""
    folder.mkdir()
    readout = Readout.of(one.scene, np.zeros(one.scene.window))
    write_files(one, folder, readout, frames_of(one), np.random.default_rng(1))
    return folder


@pytest.mark.parametrize("layout", ["recorder", "muse_raw"])
def test_the_files_are_valid_and_ingest_reads_the_frames_back(tmp_path, layout):
    one = night(tmp_path, layout=layout, window=[24, 30], frames=5)
    files = recording_files([write(one, tmp_path / "night")])
    for path in (tmp_path / "night").glob("*.fits"):
        assert path.stat().st_size % 2880 == 0
        with fits.open(path) as hdus:
            hdus.verify("exception")
    (raw,) = read_recordings(files[0], load_instrument("irlos"))
    assert raw.layout == {"recorder": "sparta_recorder", "muse_raw": "muse_raw"}[layout]
    assert np.array_equal(raw.adu, list(frames_of(one)))
    assert raw.start_unix_s == one.scene.start_unix_s


def test_counters_and_times_of_the_recorder_run_with_the_loop(tmp_path):
    one = night(tmp_path, frames=25, exposure_s=0.05, frame_rate_hz=10)
    table = fits.getdata(write(one, tmp_path / "night") / "night.fits", "IRPixelFrame")
    assert np.array_equal(np.diff(table["FrameCounter"]), [20] * 24)  # 200 Hz loop
    times = table["Seconds"] - one.scene.start_unix_s + table["USeconds"] * 1e-6
    assert times == pytest.approx(np.arange(25) * 0.1)
    assert table["USeconds"].max() < 1_000_000
    (raw,) = read_recordings(tmp_path / "night" / "night.fits", load_instrument("irlos"))
    assert raw.unix_s == pytest.approx(one.scene.start_unix_s + np.arange(25) * 0.1, abs=1e-6)


@pytest.mark.parametrize("layout", ["recorder", "muse_raw"])
def test_the_side_car_tells_everything_that_ingest_needs(tmp_path, layout):
    one = night(tmp_path, layout=layout, introduced_nm=[0, 10, 20], detector={"excess_noise_factor": 1.25})
    files = recording_files([write(one, tmp_path / "night")])
    (raw,) = read_recordings(files[0], load_instrument("irlos"))
    known = resolve(raw, AcquisitionKeys(), load_instrument("irlos"))
    told = known.acquisition
    assert known.warnings == () or all("header" in line for line in known.warnings)
    assert known.introduced_defocus_nm.tolist() == [0, 10, 20]
    assert (told.role, told.mag_j, told.exposure_s, told.seeing_arcsec) == ("ncpa_calibration", 9.0, 0.1, 0.7)
    assert told.detector.e_per_adu == 0.5 and told.detector.excess_noise_factor == 1.25
    assert told.diversity == {6: -170.0} and told.pixel_scale_mas == 9.7


def test_a_muse_file_has_the_header_and_tables_of_the_instrument(tmp_path):
    one = night(tmp_path, layout="muse_raw", derotator_angle_deg=33.0, target="HD 1")
    (path,) = write(one, tmp_path / "night").glob("*.fits")
    assert path.name == "MUSE.2024-02-11T02:20:00.000.fits" and path.with_suffix(".yaml").is_file()
    with fits.open(path) as hdus:
        header = hdus[0].header
        assert hdus["SPARTA_TT_CUBE"].data.shape == (3, 24, 24)
        assert hdus["SPARTA_ATM_DATA"].data["LGS3_SEEING"] == pytest.approx([0.7, 0.7])
    assert header["ESO AOS MAIN MODES IRLOS"] == "64x64_FullPupil_200Hz_HighGain"
    assert (header["OBJECT"], header["ESO INS DROT START"], header["ESO SEQ NGS MAG"]) == ("HD 1", 33.0, 9.0)


@pytest.mark.parametrize("layout", ["recorder", "muse_raw"])
def test_writing_needs_memory_for_a_few_frames_only(tmp_path, layout):
    def peak_bytes(frames: int) -> int:
        one = night(tmp_path, layout=layout, window=[64, 64], frames=frames)
        tracemalloc.start()
        write(one, tmp_path / f"{frames}")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    few, many = peak_bytes(20), peak_bytes(500)
    assert many < few + 0.1 * 480 * 64 * 64 * 2
