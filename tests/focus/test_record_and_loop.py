"""From exposures to records. Truth: the defocus of the images, and the controller by itself."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import focus_loop as made

from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.control.exposures import Accumulator, Exposure
from irlos_pipe.focus.loop import FocusLoop, LoopSettings
from irlos_pipe.focus.record import event_line, record_of

SETTINGS = LoopSettings(ControllerSettings(gain=0.5, delay=0))


def exposure(index: int, defocus_nm: float = 0.0, **changes) -> Exposure:
    (one,) = Accumulator(1).add(made.read(index, defocus_nm, **changes))
    return one


def loop(settings: LoopSettings = SETTINGS, last=None) -> FocusLoop:
    return FocusLoop(made.calibration(), settings, last)


def test_the_loop_closes_from_afar_and_stays():
    running, offset, residuals = loop(), 0.0, []
    for index in range(12):
        residuals.append(800.0 - offset)
        offset = running.record(exposure(index, residuals[-1]), 0.0).offset_nm
    assert np.abs(residuals[-4:]).max() < 5.0
    assert residuals[1] == 400.0  # no more than a jump at a time


def test_a_loop_that_is_started_again_goes_on_to_the_bit():
    one, other = loop(), loop()
    straight = [one.record(exposure(index, 30.0), 0.0) for index in range(6)]
    first = [other.record(exposure(index, 30.0), 0.0) for index in range(3)]
    again = loop(last=record_of(first[-1].line()))
    rest = [again.record(exposure(index, 30.0), 0.0) for index in range(3, 6)]
    keys = ("sequence", "defocus_nm", "offset_nm", "mode", "commanded")
    assert [[getattr(r, k) for k in keys] for r in first + rest] == [
        [getattr(r, k) for k in keys] for r in straight
    ]


def test_a_record_survives_the_line_it_is_written_as():
    record = loop().record(exposure(3, 123.0), 0.0)
    assert record_of(record.line()) == record
    lost = loop().record(exposure(3, image_e=np.full(made.WINDOW, np.nan)), 0.0)
    assert math.isnan(record_of(lost.line()).defocus_nm)
    assert record_of(event_line(3, 0.0, "started")) is None
    with pytest.raises(ValueError, match="not a record"):
        record_of('{"schema": "another"}')


@pytest.mark.parametrize(
    ("reason", "case", "options"),
    [
        ("not_finite", {"image_e": np.full(made.WINDOW, np.nan)}, {}),
        ("window", {"image_e": np.ones((20, 20))}, {}),
        ("lost_star", {"flux_e": 0.0}, {}),
        ("late", {}, {"overtaken": True}),
    ],
)
def test_the_offset_of_an_exposure_that_is_not_valid_is_held_and_the_record_says_why(reason, case, options):
    running = loop()
    before = running.record(exposure(0, 50.0), 0.0)
    record = running.record(exposure(1, 50.0, **case), 0.0, **options)
    assert reason in record.reasons
    assert (record.valid, record.commanded, record.offset_nm) == (False, False, before.offset_nm)


def test_a_stale_calibration_is_not_used():
    settings = LoopSettings(SETTINGS.controller, stale_after_s=10.0)
    assert loop(settings).record(exposure(9), 0.0).valid
    assert loop(settings).record(exposure(11), 0.0).reasons == ("stale_calibration",)


def test_an_exposure_of_too_few_reads_is_not_used():
    accumulator = Accumulator(4)
    accumulator.add(made.read(0, 0.0, reads=4))
    (one,) = accumulator.flush()
    assert "incomplete" in loop().record(one, 0.0).reasons


def test_a_shadow_measures_and_commands_nothing():
    record = loop(LoopSettings(SETTINGS.controller, shadow=True)).record(exposure(0, 300.0), 0.0)
    assert (record.mode, record.valid, record.commanded, record.offset_nm) == ("shadow", True, False, 0.0)
    assert record.defocus_nm == pytest.approx(300.0, abs=3.0)


def test_whatever_a_measurement_raises_becomes_a_record_and_the_offset_is_held(monkeypatch):
    running = loop()
    before = running.record(exposure(0, 50.0), 0.0)

    def broken(*_):
        raise IndexError("list index out of range")

    monkeypatch.setattr(type(made.calibration().sensor), "measurement", broken)
    record = running.record(exposure(1, 50.0), 0.0)
    assert (record.valid, record.reasons, record.offset_nm) == (False, ("failed",), before.offset_nm)
    assert running.problem == "IndexError: list index out of range"
    monkeypatch.undo()
    assert running.record(exposure(2, 50.0), 0.0).valid
    assert running.problem == ""


def test_an_absurd_frame_is_a_record_and_the_next_one_is_measured():
    running = loop()
    absurd = running.record(exposure(0, image_e=np.full(made.WINDOW, 1e38, np.float32)), 0.0)
    assert absurd.reasons == ("not_finite",)
    assert running.record(exposure(1, 50.0), 0.0).valid


def test_the_error_is_that_of_photons_with_misfit_instant_and_optics():
    record = loop().record(exposure(0, 500.0), 0.0)
    optics_nm = 4.0 + record.defocus_nm / 1000.0
    expected_nm = math.sqrt(2.0 * record.sigma_photon_nm**2 + 3.0**2 + optics_nm**2)
    assert record.sigma_nm == pytest.approx(expected_nm)
    assert record.sigma_photon_nm < 1.0


def test_without_a_ramp_that_tells_them_the_whole_error_is_not_known():
    bare = FocusLoop(replace(made.calibration(), errors=None), SETTINGS)
    record = bare.record(exposure(0, 50.0), 0.0)
    assert math.isnan(record.sigma_nm)
    assert record.sigma_photon_nm < 1.0


def test_records_of_older_loops_are_read():
    record = loop().record(exposure(3, 123.0), 0.0)
    content = json.loads(record.line())
    for key in ("sigma_photon_nm", "recording", "recorded_unix_s"):
        content.pop(key)
    assert record_of(json.dumps(content)).state == record.state
