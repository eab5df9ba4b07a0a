"""Which recordings ingest starts from: each once, and none stopped by another."""

import logging

import numpy as np
import pytest
from astropy.io import fits
from helpers.sparta_files import counts, star, write_recorder, write_sidecar

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers import find
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.stages.ingest.sources import examined, read_sources
from irlos_pipe.stages.ingest.stage import Config
from irlos_pipe.stages.ingest.work import ingest

IRLOS = load_instrument("irlos")
CUBE = counts(star(12, 12), 3)
LOG = logging.getLogger("test")


def read(folder):
    return read_sources({"cube": [folder]}, lambda _: AcquisitionKeys(), IRLOS, LOG)


def test_the_same_frames_under_another_description_are_a_failure(tmp_path):
    for name, nm in (("a", 0.0), ("b", 50.0)):
        write_recorder(tmp_path / name, CUBE, keys={"introduced_defocus_nm": nm})
    sources, failures = read(tmp_path)
    assert len(sources) == 1 and "b.fits: the same frames as in" in failures[0][1]


def test_an_error_that_nobody_foresaw_costs_one_recording_only(tmp_path, monkeypatch):
    for name, seed in (("a", 1), ("b", 2)):
        write_recorder(tmp_path / name, counts(star(12, 12), 3, seed=seed))
    true = find.recorder.read

    def crash_on_a(path, *others):
        if path.stem == "a":
            raise ZeroDivisionError("a bug")
        return true(path, *others)

    monkeypatch.setattr(find.recorder, "read", crash_on_a)
    sources, failures = read(tmp_path)
    assert [source.raw.name for source in sources] == ["b"]
    assert "a.fits" in failures[0][1] and "a bug" in failures[0][1]


def test_a_recording_that_does_not_fit_into_the_memory_is_refused_before_it_is_cleaned(tmp_path, monkeypatch):
    write_recorder(tmp_path / "a", CUBE)
    (source,), _ = read(tmp_path)
    monkeypatch.setattr("irlos_pipe.files.processes.available_bytes", lambda: 1e5)
    with pytest.raises(InputDataError, match=r"3 frames of 12x12 px: needs about 0\.0 GB of memory"):
        ingest(source, Config(), IRLOS)


@pytest.mark.parametrize("copy", ["copy.fits", "copy.fits.gz"])
def test_a_copy_of_a_recording_is_left_out_and_named(tmp_path, caplog, copy):
    for name in ("cube.fits", copy):
        fits.writeto(tmp_path / name, CUBE)
    write_sidecar(tmp_path / "acquisition.yaml")
    sources, failures = read(tmp_path)
    assert len(sources) == 1 and not failures
    assert [record.levelname for record in caplog.records if "a copy of" in record.getMessage()] == [
        "WARNING"
    ]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"pixel_scale_mas": 9.7, "introduced_defocus_nm": [0.0, 50.0, -50.0]}, ""),
        ({"pixel_scale_mas": 60.0}, "λ/D at 1600 nm and D = 8 m is 0.69 px"),
        # the slope of 1 um RMS at the rim, 8 sqrt(3) 1e-6 / 8 rad, is 357 mas, and the disc twice this
        (
            {"pixel_scale_mas": 9.7, "introduced_defocus_nm": 1000.0},
            "1000 nm RMS spreads the star over 74 px",
        ),
    ],
)
def test_an_image_that_pixels_or_window_cannot_hold_is_said_before_any_work(tmp_path, caplog, keys, said):
    fits.writeto(tmp_path / "cube.fits", np.ones((3, 40, 40), np.int32))
    write_sidecar(tmp_path / "acquisition.yaml", **keys)
    inputs = {"cube": [tmp_path]}
    for find_out in (
        lambda: examined(inputs, Config(), IRLOS),
        lambda: read_sources(inputs, Config().keys_for, IRLOS, LOG),
    ):
        caplog.clear()
        find_out()
        lines = [one.getMessage() for one in caplog.records if "λ/D" in one.msg or "spreads" in one.msg]
        assert (len(lines) == 1 and said in lines[0]) if said else not lines


def test_sums_that_the_frames_do_not_make_are_said_before_any_work(tmp_path):
    fits.writeto(tmp_path / "cube.fits", np.ones((3, 40, 40), np.int32))
    write_sidecar(tmp_path / "acquisition.yaml", pixel_scale_mas=9.7, exposure_s=0.1)

    def wrong(**settings) -> list[str]:
        return examined({"cube": [tmp_path]}, Config(**settings), IRLOS)[0]

    (line,) = wrong(accumulate_s_of={"cube": 0.15})
    assert "do not add up" in line
    assert wrong(accumulate_s_of={"cube": 0.2}) == wrong() == []
