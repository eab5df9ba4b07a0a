"""From exposures to records. Truth: the defocus of the images, and the controller by itself."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import focus_loop as made

from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.focus.journal import event_line, record_of
from irlos_pipe.focus.service import FocusLoop, LoopSettings

SETTINGS = LoopSettings(ControllerSettings(gain=0.5, delay=0))


def loop(settings: LoopSettings = SETTINGS, last=None) -> FocusLoop:
    return FocusLoop(made.calibration(), settings, last)


def test_the_loop_closes_from_afar_and_stays():
    running, offset, residuals = loop(), 0.0, []
    for index in range(12):
        residuals.append(800.0 - offset)
        offset = running.record(made.exposure(index, residuals[-1]), 0.0).offset_nm
    assert np.abs(residuals[-4:]).max() < 5.0
    assert residuals[1] == 400.0  # no more than a jump at a time


def test_a_loop_that_is_started_again_goes_on_to_the_bit():
    one, other = loop(), loop()
    straight = [one.record(made.exposure(index, 30.0), 0.0) for index in range(6)]
    first = [other.record(made.exposure(index, 30.0), 0.0) for index in range(3)]
    again = loop(last=record_of(first[-1].line()))
    rest = [again.record(made.exposure(index, 30.0), 0.0) for index in range(3, 6)]
    timed = {"latency_ms": 0.0, "recorded_unix_s": 0.0}
    assert [replace(one, **timed) for one in first + rest] == [replace(one, **timed) for one in straight]


def test_a_record_survives_the_line_it_is_written_as():
    record = loop().record(made.exposure(3, 123.0), 0.0)
    assert record_of(record.line()) == record
    lost = loop().record(made.exposure(3, image_e=np.full(made.WINDOW, np.nan)), 0.0)
    assert math.isnan(record_of(lost.line()).defocus_nm)
    assert record_of(event_line(3, 0.0, "started")) is None
    with pytest.raises(ValueError, match="not a record"):
        record_of('{"schema": "another"}')


@pytest.mark.parametrize(
    ("reasons", "case", "options"),
    [
        (("not_finite",), {"image_e": np.full(made.WINDOW, np.nan)}, {}),
        (("not_finite",), {"image_e": np.full(made.WINDOW, 1e38, np.float32)}, {}),
        (("window",), {"image_e": np.ones((20, 20))}, {}),
        (("lost_star",), {"flux_e": 0.0}, {}),
        (("late",), {}, {"overtaken": True}),
    ],
)
def test_the_offset_of_an_exposure_that_is_not_valid_is_held_and_the_record_says_why(reasons, case, options):
    running = loop()
    before = running.record(made.exposure(0, 50.0), 0.0)
    record = running.record(made.exposure(1, 50.0, **case), 0.0, **options)
    assert {*reasons} <= {*record.reasons}
    assert (record.valid, record.commanded, record.offset_nm) == (False, False, before.offset_nm)
    assert running.record(made.exposure(2, 50.0), 0.0).valid


def test_whatever_a_measurement_raises_becomes_a_record_and_the_offset_is_held(monkeypatch):
    running = loop()
    before = running.record(made.exposure(0, 50.0), 0.0)
    monkeypatch.setattr(type(made.calibration().sensor), "measurement", lambda *_: [][0])
    record = running.record(made.exposure(1, 50.0), 0.0)
    assert (record.valid, record.reasons, record.offset_nm) == (False, ("failed",), before.offset_nm)
    assert running.problem == "IndexError: list index out of range"
    monkeypatch.undo()
    assert running.record(made.exposure(2, 50.0), 0.0).valid
    assert running.problem == ""


def test_the_error_is_that_of_photons_with_misfit_instant_and_optics_where_a_ramp_shows_them():
    record = loop().record(made.exposure(0, 500.0), 0.0)
    optics_nm = 4.0 + record.defocus_nm / 1000.0
    expected_nm = math.sqrt(2.0 * record.sigma_photon_nm**2 + 3.0**2 + optics_nm**2)
    assert record.sigma_nm == pytest.approx(expected_nm)
    assert record.sigma_photon_nm < 1.0
    bare = FocusLoop(replace(made.calibration(), errors=None), SETTINGS)
    assert math.isnan(bare.record(made.exposure(0, 50.0), 0.0).sigma_nm)
