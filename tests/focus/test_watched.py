"""Recordings that appear in a folder. Truth: the counts that were written."""

import os
import re
import threading
import time

import numpy as np
import pytest
from astropy.io import fits
from helpers import sparta_files as sparta

from irlos_pipe.focus import recordings as watched_module
from irlos_pipe.focus.journal import Earlier
from irlos_pipe.focus.recordings import WatchedFolder
from irlos_pipe.focus.source import Fault
from irlos_pipe.frames.recording import Acquisition, Detector
from irlos_pipe.instrument.instrument import load_instrument

INSTRUMENT = load_instrument("irlos")
CALIBRATED = Acquisition("psf", Detector(0.5, 1.0), ((1600.0, 1.0),), {6: -170.0}, 9.7)
DARK = np.full((32, 32), 50.0)


def watched(tmp_path, **options) -> WatchedFolder:
    return WatchedFolder(tmp_path, INSTRUMENT, CALIBRATED, **options)


def write(folder, first: int, frames: int = 3, **keys) -> np.ndarray:
    adu = sparta.counts(sparta.star(), frames, seed=first)
    counter = np.arange(first, first + frames)
    path = sparta.write_recorder(folder, adu, keys=keys, maps={"DARK": DARK}, counter=counter)
    _age(path)
    return adu


def _age(path) -> None:
    """As if it had been written a while ago."""
    os.utime(path, (time.time() - 10,) * 2)


def arrivals(source: WatchedFolder, polls: int = 3) -> list:
    return [one for _ in range(polls) for one in source.poll(0.0)]


def test_frames_of_new_recordings_come_in_order_and_in_electrons(tmp_path):
    write(tmp_path / "before", 0)
    source = watched(tmp_path)
    adu = write(tmp_path / "scan_1", 10)
    write(tmp_path / "scan_2", 20)
    found = arrivals(source)
    assert [one.counter for one in found] == [10, 11, 12, 20, 21, 22]
    np.testing.assert_allclose(found[1].image_e, (adu[1] - 50.0) * 0.5, rtol=1e-5, atol=1e-3)
    assert arrivals(source) == []


def test_a_file_that_is_still_being_written_is_waited_for(tmp_path):
    source = watched(tmp_path)
    write(tmp_path / "scan", 0)
    path = tmp_path / "scan" / "scan.fits"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])  # its time is now
    assert arrivals(source) == []
    path.write_bytes(whole)
    _age(path)
    assert len(arrivals(source)) == 3


def test_frames_that_a_file_gets_after_it_was_read_follow_and_none_comes_twice(tmp_path):
    source = watched(tmp_path)
    path = tmp_path / "scan" / "scan.fits"
    write(tmp_path / "scan", 0, frames=5)
    whole = path.read_bytes()
    write(tmp_path / "scan", 0, frames=2)
    assert [one.counter for one in arrivals(source)] == [0, 1]
    path.write_bytes(whole[: len(whole) // 2])  # a copy that stalls
    _age(path)
    assert isinstance(arrivals(source)[0], Fault)
    path.write_bytes(whole)
    os.utime(path, (time.time() - 5,) * 2)
    assert [one.counter for one in arrivals(source)] == [2, 3, 4]
    os.utime(path, (time.time() - 4,) * 2)
    (fault,) = arrivals(source)
    assert "no more frames than were read" in fault.text


@pytest.mark.parametrize("hit", [(1, 3, 4), (slice(None), 3, 4), 1, slice(None)])
def test_pixels_that_are_no_numbers_cost_their_frames_alone(tmp_path, hit):
    source = watched(tmp_path)
    adu = sparta.counts(sparta.star(), 3, seed=1).astype(np.float32)
    adu[hit] = np.nan
    fits.writeto(tmp_path / "plain.fits", adu)
    _age(tmp_path / "plain.fits")
    found = arrivals(source)
    assert [one.counter for one in found] == [0, 1, 2]
    for one, frame in zip(found, adu, strict=True):
        np.testing.assert_array_equal(np.isfinite(one.image_e), np.isfinite(frame))


def broken(path) -> None:
    path.write_bytes(b"SIMPLE  =                    T" + b"x" * 3000)


def huge(path) -> None:
    os.truncate(path, 20 << 30)


@pytest.mark.parametrize(
    ("harm", "words"), [(broken, "a.fits"), (huge, "20.0 GiB, more than a recording has; not read")]
)
def test_a_damaged_or_huge_file_is_named_in_one_line_and_the_next_one_read(tmp_path, harm, words):
    source = watched(tmp_path)
    write(tmp_path / "a", 0)
    write(tmp_path / "b", 5)
    harm(tmp_path / "a" / "a.fits")
    _age(tmp_path / "a" / "a.fits")
    fault, *rest = arrivals(source)
    assert isinstance(fault, Fault)
    assert words in fault.text and "\n" not in fault.text
    assert [one.counter for one in rest] == [5, 6, 7]


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("spectrum", [{"wavelength_nm": 2200.0, "weight": 1.0}], "2200 nm.*not 1600 nm"),
        ("role", "dark", "role dark"),
        ("detector", {"e_per_adu": 0.5, "coadds": 4, "coadds_averaged": True}, "e_per_adu 2, not 0.5"),
        ("instrument", "pharo", "instrument pharo"),
    ],
)
def test_a_recording_that_was_taken_otherwise_is_named_and_not_used(tmp_path, key, value, words):
    source = watched(tmp_path)
    write(tmp_path / "scan", 5, **{key: value})
    (fault,) = arrivals(source)
    assert isinstance(fault, Fault)
    assert re.search(rf"scan/acquisition.yaml: .*{words}", fault.text)


def test_a_side_car_that_comes_late_is_named_if_it_contradicts_frames_that_were_used(tmp_path):
    source = watched(tmp_path)
    fits.writeto(tmp_path / "scan.fits", sparta.counts(sparta.star(), 3))
    _age(tmp_path / "scan.fits")
    assert len(arrivals(source)) == 3
    sparta.write_sidecar(tmp_path / "scan.yaml", pixel_scale_mas=9.7)
    assert arrivals(source) == []
    sparta.write_sidecar(tmp_path / "scan.yaml", pixel_scale_mas=12.0)
    (fault,) = arrivals(source)
    assert re.search(r"pixel_scale_mas 12, not 9.7; not used; .* late: 3 frames have been used", fault.text)


def test_frames_have_the_times_of_their_header_not_that_of_the_copy(tmp_path):
    """Of a day before, at 10 frames a second."""
    source = watched(tmp_path)
    header = fits.Header({"DATE-OBS": "2024-02-10T03:02:00"})
    fits.writeto(tmp_path / "scan.fits", sparta.counts(sparta.star(), 3), header)
    sparta.write_sidecar(tmp_path / "scan.yaml", frame_rate_hz=10)
    _age(tmp_path / "scan.fits")
    assert [one.unix_s for one in arrivals(source)] == pytest.approx(
        [1707534120.0, 1707534120.1, 1707534120.2]
    )


def test_pixels_above_the_saturation_of_their_side_car_are_infinite(tmp_path):
    """The raw level counts, with the dark in it."""
    source = watched(tmp_path)
    level = 1000
    adu = write(tmp_path / "scan", 0, detector={"saturation_adu": level})
    assert (adu >= level).any()
    for one, frame in zip(arrivals(source), adu, strict=True):
        np.testing.assert_array_equal(np.isinf(one.image_e), frame >= level)


def test_each_recording_is_named_and_those_of_an_earlier_loop_are_not_read_again(tmp_path):
    for name, first in (("a", 10), ("b", 0), ("c", 5)):
        write(tmp_path / name, first)
    found = arrivals(watched(tmp_path, earlier=Earlier()))
    assert [(one.recording, one.counter) for one in found if one.recording != "c/c.fits"] == [
        *(("a/a.fits", counter) for counter in (10, 11, 12)),
        *(("b/b.fits", counter) for counter in (0, 1, 2)),
    ]
    half_done = Earlier(0.0, frozenset({"a/a.fits", "b/b.fits"}), "b/b.fits")
    found = arrivals(watched(tmp_path, earlier=half_done))
    assert [one.recording for one in found] == ["b/b.fits"] * 3 + ["c/c.fits"] * 3
    later = Earlier(time.time() + 10.0)
    assert arrivals(watched(tmp_path, earlier=later)) == []  # there before the first start


@pytest.mark.slow
def test_a_file_that_takes_long_is_told_of_and_given_up_and_the_next_one_read(tmp_path, monkeypatch):
    release, real = threading.Event(), watched_module.read_recordings

    def slow(path, instrument):
        if path.parent.name == "a":
            release.wait(30)
        return real(path, instrument)

    monkeypatch.setattr(watched_module, "read_recordings", slow)
    for name, value in (("PATIENCE_S", 0.01), ("TOLD_S", 0.1), ("GIVEN_UP_S", 0.3)):
        monkeypatch.setattr(watched_module, name, value)
    source = watched(tmp_path)
    write(tmp_path / "a", 0)
    write(tmp_path / "b", 5)
    found = [one for _ in range(12) for one in source.poll(0.05)]
    release.set()
    assert "a/a.fits since 0 s" in found[0].text
    assert "given up" in found[1].text
    assert [one.counter for one in found[2:]] == [5, 6, 7]
