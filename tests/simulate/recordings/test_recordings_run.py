"""Running a simulation: what is made, what is skipped and why, and that nothing half done is ever seen."""

import hashlib
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from astropy.io import fits
from filelock import FileLock
from helpers.simulation_specs import CUBE, RAMP, planned, simulated, spec_of, truth

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError, Locked
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.acquisition import resolve
from irlos_pipe.readers.find import read_recordings, recording_files
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.recordings import run as making
from irlos_pipe.simulate.recordings.files import Planned, write_files

NIGHT = {"cube": CUBE, "ramp": RAMP}
HIDDEN = {"companion": {"flux_ratio": 0.1, "sep_mas": 90, "pa_deg": 0}}


def checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of every visible file."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def made(steps) -> list[str]:
    return [step.planned.name for step in steps if step.reason]


@pytest.mark.slow
def test_the_same_spec_and_seed_make_the_same_bytes_whatever_the_number_of_processes(tmp_path):
    pair = {"cube": CUBE, "faint": CUBE | {"mag_j": 12.0}}
    sky = spec_of(pair, sky={"seeing_arcsec": 0.5}, motion={}, ncpa={"total_nm": 100})
    simulated(tmp_path / "one", sky)
    simulated(tmp_path / "two", sky, jobs=2)
    simulated(tmp_path / "other", sky | {"seed": 6})
    one, two, other = (checksums(tmp_path / name) for name in ("one", "two", "other"))
    assert one == two
    assert all(one[name] != other[name] for name in one if name.endswith((".json", "cube.fits")))


@pytest.mark.parametrize(
    ("change", "expected", "why"),
    [
        ({"seed": 6}, ["cube", "ramp/offset_00", "ramp/offset_01", "ramp/offset_02"], "seed"),
        ({"recordings": NIGHT | {"cube": CUBE | {"mag_j": 10.0}}}, ["cube"], "mag_j"),
        ({"recordings": NIGHT | {"cube": CUBE | {"effects": HIDDEN}}}, ["cube"], "companion"),
        (
            {"recordings": NIGHT | {"ramp": RAMP | {"offsets_nm": [-200, 0, 9]}}},
            ["ramp/offset_02"],
            "commanded_nm",
        ),
    ],
    ids=["seed", "magnitude", "effect", "offset"],
)
def test_only_what_changed_is_made_again_and_the_reason_is_told(tmp_path, change, expected, why):
    simulated(tmp_path / "out", spec_of(NIGHT))
    steps = simulated(tmp_path / "out", spec_of(NIGHT) | change)
    assert made(steps) == expected
    assert all(why in step.reason for step in steps if step.reason)


def test_data_from_elsewhere_are_never_replaced(tmp_path):
    own = tmp_path / "out" / "data" / "cube"
    own.mkdir(parents=True)
    (own / "precious.fits").write_text("night of 11 February")
    with pytest.raises(ConfigurationError, match=r"data/cube: is there, but was not made by irlos simulate"):
        simulated(tmp_path / "out", spec_of(NIGHT), force=True)
    assert [path.name for path in (tmp_path / "out").rglob("*") if path.is_file()] == ["precious.fits"]


def test_an_interruption_leaves_finished_recordings_and_nothing_half_done(tmp_path, monkeypatch):
    real = making.record

    def stops_in_the_ramp(planned, folder, spool, report):
        if planned.name == "ramp/offset_01":
            (folder / "offset_01.fits").write_text("half")
            raise KeyboardInterrupt
        return real(planned, folder, spool, report)

    monkeypatch.setattr(making, "record", stops_in_the_ramp)
    with pytest.raises(KeyboardInterrupt):
        simulated(tmp_path / "out", spec_of(NIGHT))
    left = checksums(tmp_path / "out")
    assert "data/ramp/offset_00/offset_00.fits" in left and not any("offset_01" in name for name in left)
    assert not list((tmp_path / "out").glob(".simulating-*"))
    monkeypatch.undo()
    assert made(simulated(tmp_path / "out", spec_of(NIGHT))) == ["ramp/offset_01", "ramp/offset_02"]


def test_a_recording_that_fails_while_it_is_replaced_leaves_the_old_one(tmp_path, monkeypatch):
    simulated(tmp_path / "out", spec_of({"cube": CUBE}))
    before = checksums(tmp_path / "out" / "data")

    def full_disk(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(making, "record", full_disk)
    with pytest.raises(IrlosError, match="the disk is full"):
        simulated(tmp_path / "out", spec_of({"cube": CUBE | {"mag_j": 10.0}}))
    assert checksums(tmp_path / "out" / "data") == before


def test_a_folder_in_use_is_left_alone(tmp_path):
    (tmp_path / "out").mkdir()
    with FileLock(tmp_path / "out" / ".lock"), pytest.raises(Locked):
        simulated(tmp_path / "out", spec_of({"cube": CUBE}))


# An effect of each kind, switched on in a spec, reaches the frames and the truth, not the side-car; keys of
# effects are generated. Expected: the same recording without the effect, of the same seed. The tests of the
# simulator check how large an effect is.


SIZES = {
    "vibration": {"sigma_mas": 8, "angle_deg": 70, "frequency_hz": 48.3, "shape": "gaussian"},
    "uneven_residual": {"edge": 0.4},
    "plate_scale": {"fraction": 0.02},
    "diversity_error": {"nm": 20},
    "pupil_geometry": {"obscuration_m": 1.3},
    "high_order_ncpa": {"zernike_nm": {60: 40}},
    "phase_bump": {"nm": 150, "x_m": 1.5, "y_m": -1.0, "width_m": 0.8},
    "companion": {"flux_ratio": 0.05, "sep_mas": 60, "pa_deg": 30},
    "interpixel_crosstalk": {"fraction": 0.05},
    "correlated_noise": {"e_rms": 100.0},
    "bad_pixels": [[3, 4], [15, 7]],
    "focus_stage_offset": {"nm": 40},
    "high_aperture": {"sine": 0.85},
}
FINE = {"pupil_samples": 64, "points_per_band": 3}
BRIGHT = {"mag_j": 6.0, "detector": {"e_per_adu": 5.0, "read_noise_e": 2.0}}
ONE = CUBE | BRIGHT | {"introduced_nm": 150.0, "sampling": FINE}


def recording(folder, effects: dict) -> tuple[np.ndarray, dict, dict]:
    """Mean image [ADU], side-car and truth of a recording without sky."""
    simulated(folder, spec_of({"one": ONE | {"effects": effects}}))
    data = folder / "data" / "one"
    table = fits.getdata(data / "one.fits", "IRPixelFrame")
    image = table["Pixels"].reshape(-1, 24, 24).mean(axis=0)
    return image, yaml.safe_load((data / "acquisition.yaml").read_text()), truth(folder, "one")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return recording(tmp_path_factory.mktemp("plain") / "out", {})


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZES)
def test_an_effect_changes_the_frames_and_is_told_in_the_truth_alone(tmp_path, plain, name):
    """An error of the wavefront is part of the true one."""
    image, side_car, told = recording(tmp_path / "out", {name: SIZES[name]})
    noise_adu = np.sqrt(2 * ((plain[0] - 200) * 5 + 4) / 3) / 5
    assert np.abs((image - plain[0]) / noise_adu).max() > 8
    assert side_car == plain[1]
    assert list(told["hidden"]) == [name] and plain[2]["hidden"] == {}
    mean_nm, before_nm = told["mean_zernike_nm"], plain[2]["mean_zernike_nm"]
    changed = {noll for noll in mean_nm if abs(mean_nm[noll] - before_nm[noll]) > 1}
    # Modes beyond Noll 31 are in the wavefront, but are none of those that the file lists.
    wrong = {"diversity_error": {"6"}, "focus_stage_offset": {"4"}, "high_order_ncpa": set()}
    only = (wrong | {"phase_bump": {*mean_nm}}).get(name, changed)
    assert changed <= only and bool(changed) == bool(only)
    stated = {noll for noll, value in told["ncpa_nm"].items() if value != plain[2]["ncpa_nm"].get(noll, 0.0)}
    assert stated == {"diversity_error": {"6"}, "high_order_ncpa": {"60"}}.get(name, set())


# Files of simulated recordings, read back with the readers of ingest, astropy and PyYAML.
# Truth: the frames handed to the writer, and the definition of the layouts in FITS.


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
