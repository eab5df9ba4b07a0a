"""When a recording began, from its header in every layout. Truth: astropy's times, and 1970 as MJD 40587."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from helpers.sparta_files import counts, star, write_recorder

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.times import start_of

STAMP = "2021-05-01T05:00:00"
UNIX_S = Time(STAMP, scale="utc").unix
MJD = Time(STAMP, scale="utc").mjd


@pytest.mark.parametrize(
    "cards",
    [
        {"DATE-OBS": STAMP},
        {"DATE-OBS": STAMP, "MJD-OBS": 50000.0},
        {"DATE-OBS": f"{STAMP}Z"},
        {"DATE-BEG": STAMP},
        {"MJD-OBS": MJD},
        {"DATE-OBS": "2021-05-01", "MJD-OBS": MJD},
        {"DATE-OBS": "2021-05-01", "UTC": "05:00:00"},
        {"DATE-OBS": "2021-05-01", "TIME-OBS": "05:00:00"},
        {"DATE-OBS": "01/05/21", "MJD-OBS": MJD},
    ],
)
def test_the_date_of_a_header_is_read_however_it_is_told(cards):
    assert start_of(fits.Header(cards)) == pytest.approx(UNIX_S, abs=1e-3)


@pytest.mark.parametrize(
    "cards",
    [
        {},
        {"DATE-OBS": ""},
        {"DATE-OBS": "2021-02-31T00:00:00"},
        {"MJD-OBS": 0.0},
        {"MJD-OBS": 1e300},
        {"MJD-OBS": "x"},
    ],
)
def test_what_is_no_date_is_no_date(cards):
    assert np.isnan(start_of(fits.Header(cards)))


def test_cubes_and_recorder_tables_without_times_have_the_date_of_their_header(tmp_path):
    cube = counts(star(12, 12), 3)
    fits.writeto(tmp_path / "c.fits", cube, fits.Header({"DATE-OBS": STAMP}))
    recorder = write_recorder(tmp_path / "rec", cube)
    fits.setval(recorder, "MJD-OBS", value=MJD)
    for path in (tmp_path / "c.fits", recorder):
        (raw,) = read_recordings(path, load_instrument("irlos"))
        assert raw.start_unix_s == pytest.approx(UNIX_S, abs=1e-3)
