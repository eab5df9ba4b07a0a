"""The program around the loop. Truth: the reads that were given to it, and the loop by itself."""

import json
import socket
import sqlite3
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from helpers import focus_loop as made

from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.control.exposures import Accumulator
from irlos_pipe.conventions.errors import ConfigurationError, ExitCode, InputDataError, Locked
from irlos_pipe.focus import service as service_module
from irlos_pipe.focus.calibration import CalibrationWatch, require_exchangeable
from irlos_pipe.focus.loop import FocusLoop, LoopSettings
from irlos_pipe.focus.mailbox import Mailbox
from irlos_pipe.focus.service import Service
from irlos_pipe.focus.source import Fault, Notice

SETTINGS = LoopSettings(ControllerSettings(gain=0.5, delay=0), reads=2)
CLOCKED = {"latency_ms": 0, "recorded_unix_s": 0}  # what depends on the moment


@dataclass
class Listed:
    """A source of what was arranged, poll after poll."""

    arrivals: list
    window: tuple[int, int] = made.WINDOW
    closed: list = field(default_factory=list)

    def poll(self, timeout_s):
        return self.arrivals.pop(0) if self.arrivals else None

    def close(self):
        self.closed.append(True)


def service(output: Path, arrivals: list, found=None, **changes) -> Service:
    source = Listed(arrivals, changes.pop("window", made.WINDOW))
    request = made.Ready(output / "none", found or made.calibration())
    settings = changes.pop("settings", SETTINGS)
    return Service(output, request, settings, lambda *_: source, **changes)


def reads(first: int, last: int, defocus_nm: float = 30.0) -> list[list]:
    """Two reads per exposure, one poll each."""
    return [[made.read(counter, defocus_nm, reads=2)] for counter in range(first, last)]


def lines(output: Path) -> tuple[list[dict], list[str]]:
    content = [json.loads(line) for line in (output / "focus.jsonl").read_text().splitlines()]
    return [one for one in content if "sequence" in one], [one["event"] for one in content if "event" in one]


def test_every_exposure_has_a_record_and_the_command_is_that_of_the_last(tmp_path):
    told = []
    assert service(tmp_path, reads(0, 8)).run(told.append) == 4
    records, events = lines(tmp_path)
    assert [one["exposure"] for one in records] == [0, 1, 2, 3]
    assert events == ["started, calibration first", "stopped"] == told
    command = Mailbox(tmp_path / "command").read()
    assert (command.number, command.offset_nm, command.counter) == (4, records[-1]["offset_nm"], 6)


def test_records_are_those_of_the_loop_by_itself(tmp_path):
    service(tmp_path, reads(0, 8)).run(lambda _: None)
    loop, accumulator = FocusLoop(made.calibration(), SETTINGS), Accumulator(2)
    exposures = [one for (read,) in reads(0, 8) for one in accumulator.add(read)]
    alone = [json.loads(loop.record(one, 0.0).line()) for one in exposures]
    for mine, theirs in zip(lines(tmp_path)[0], alone, strict=True):
        assert mine | CLOCKED == theirs | CLOCKED


def test_started_again_it_goes_on_and_does_nothing_twice(tmp_path):
    service(tmp_path, reads(0, 5)).run(lambda _: None)  # the third exposure is cut short
    service(tmp_path, reads(0, 12)).run(lambda _: None)
    records, events = lines(tmp_path)
    assert [one["exposure"] for one in records] == [0, 1, 2, 3, 4, 5]
    assert [one["sequence"] for one in records] == [1, 2, 3, 4, 5, 6]
    assert records[2]["reads_missing"] == 1
    assert "started again after record 3, calibration first" in events


def test_of_exposures_that_come_together_only_the_last_commands(tmp_path):
    at_once = [read for (read,) in reads(0, 8)]
    service(tmp_path, [at_once]).run(lambda _: None)
    records, _ = lines(tmp_path)
    assert [one["reasons"] for one in records] == [["late"]] * 3 + [[]]
    assert [one["commanded"] for one in records] == [False, False, False, True]


def test_in_a_replay_every_exposure_counts(tmp_path):
    at_once = [read for (read,) in reads(0, 8)]
    service(tmp_path, [at_once], every_exposure_counts=True).run(lambda _: None)
    assert all(one["valid"] for one in lines(tmp_path)[0])


def test_what_is_damaged_is_named_and_the_offset_held(tmp_path):
    arrivals = [
        *reads(0, 4),
        [Fault("frame 5 is damaged")],
        [made.nan_read(5)],
        [made.nan_read(6)],
        *reads(7, 10),
    ]
    service(tmp_path, arrivals).run(lambda _: None)
    records, events = lines(tmp_path)
    assert "frame 5 is damaged" in events
    assert records[2]["reads_damaged"] == 1
    assert records[2]["reasons"] == ["not_finite"]
    offsets = [one["offset_nm"] for one in records]
    assert offsets[1] == offsets[2] == offsets[3]  # the fourth holds a read that is no number, too
    assert offsets[4] != offsets[3]


def test_frames_of_another_window_are_recorded_as_such(tmp_path):
    odd = [[made.read(counter, 0.0, image_e=np.ones((8, 8)))] for counter in (2, 3)]
    service(tmp_path, [*reads(0, 2), *odd]).run(lambda _: None)
    assert lines(tmp_path)[0][1]["reasons"] == ["window"]


def test_a_source_of_another_window_is_refused_at_the_start(tmp_path):
    with pytest.raises(InputDataError, match=r"20x24 px.*32x32"):
        service(tmp_path, [], window=(20, 24)).run(lambda _: None)


def test_two_loops_on_one_output_are_refused(tmp_path):
    class Second(Listed):
        def poll(self, timeout_s):
            with pytest.raises(Locked) as caught:
                service(tmp_path, []).run(lambda _: None)
            assert caught.value.exit_code == ExitCode.LOCKED
            return

    first = service(tmp_path, [])
    Service(tmp_path, first.calibration, SETTINGS, lambda *_: Second([])).run(lambda _: None)


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("text")
    with pytest.raises(ConfigurationError, match=r"thesis\.tex"):
        service(tmp_path, []).run(lambda _: None)


def test_an_interrupted_loop_records_what_it_has(tmp_path):
    class Interrupted(Listed):
        def poll(self, timeout_s):
            if not self.arrivals:
                raise KeyboardInterrupt
            return super().poll(timeout_s)

    request = made.Ready(tmp_path, made.calibration())
    with pytest.raises(KeyboardInterrupt):
        Service(tmp_path, request, SETTINGS, lambda *_: Interrupted(reads(0, 4))).run(lambda _: None)
    assert len(lines(tmp_path)[0]) == 2
    with sqlite3.connect(tmp_path / "focus.sqlite") as connection:
        assert connection.execute("SELECT count(*) FROM records").fetchone() == (2,)


def test_a_clock_that_is_set_is_noted_and_changes_nothing_else(tmp_path, monkeypatch):
    real, steps = service_module.time.time, iter([0.0, 0.0, 0.0] + [3600.0] * 100)
    monkeypatch.setattr(service_module.time, "time", lambda: real() + next(steps))
    service(tmp_path, reads(0, 8)).run(lambda _: None)
    records, events = lines(tmp_path)
    assert sum("the clock was set by +3600.0 s" in event for event in events) == 1
    assert all(one["valid"] for one in records)


# -- calibrations exchanged -------------------------------------------------------------------------


@dataclass
class Changing:
    """A run folder whose calibration is whatever `found` says."""

    run: Path
    found: object

    def load(self):
        if isinstance(self.found, Exception):
            raise self.found
        return self.found


def exchanged(tmp_path, found):
    """News of a watch whose run is made again."""
    results = tmp_path / "results.json"
    results.write_text("{}")
    request = Changing(tmp_path, found)
    watch = CalibrationWatch(request, made.calibration())
    assert watch.news() is None
    results.rename(tmp_path / "old.json")
    results.write_text("{} ")
    watch._looked_s = -1e9
    assert watch.news() is None
    watch._worker.join()
    return watch, watch.news()


def test_a_calibration_that_is_made_again_is_taken(tmp_path):
    new = made.calibration("second")
    watch, news = exchanged(tmp_path, new)
    assert news.calibration is new is watch.current


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (InputDataError("no calibration here"), "no calibration here"),
        (RuntimeError("something unforeseen"), "something unforeseen"),
        (made.calibration("foreign", "nirc2_narrow"), "instrument nirc2_narrow.*runs on irlos"),
    ],
    ids=["broken", "unforeseen", "another instrument"],
)
def test_one_that_cannot_be_used_leaves_the_loop_with_what_it_has(tmp_path, found, words):
    watch, news = exchanged(tmp_path, found)
    assert news.calibration is None
    assert watch.current.name == "first"
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(news.problem)


def test_the_same_calibration_is_exchangeable():
    require_exchangeable(made.calibration(), made.calibration("second"))


def test_a_calibration_for_other_frames_is_not_exchangeable():
    old = made.calibration()
    other = replace(old, acquisition=replace(old.acquisition, pixel_scale_mas=12.0))
    with pytest.raises(InputDataError, match=r"pixel_scale_mas 12, not 9\.7"):
        require_exchangeable(old, other)


def test_what_has_to_be_said_of_a_calibration_is_said(tmp_path):
    found = replace(made.calibration(), notice="simulated sample")
    service(tmp_path, [], found).run(lambda _: None)
    assert lines(tmp_path)[1] == [
        "started, calibration first",
        "calibration first: simulated sample",
        "stopped",
    ]


# -- frames ------------------------------------------------------------------------------------------


def test_a_shadow_measures_every_exposure_however_late_it_comes(tmp_path):
    at_once = [read for (read,) in reads(0, 8)]
    service(tmp_path, [at_once], settings=replace(SETTINGS, shadow=True)).run(lambda _: None)
    assert [one["valid"] for one in lines(tmp_path)[0]] == [True] * 4


def test_a_recording_with_lower_counters_than_the_one_before_is_measured(tmp_path):
    first = [replace(read, recording="a") for (read,) in reads(100, 104)]
    second = [replace(read, recording="b") for (read,) in reads(0, 4)]
    service(tmp_path, [[one] for one in (*first, *second)]).run(lambda _: None)
    records, _ = lines(tmp_path)
    assert [(one["recording"], one["exposure"], one["reads_late"]) for one in records] == [
        ("a", 50, 0),
        ("a", 51, 0),
        ("b", 0, 0),
        ("b", 1, 0),
    ]


def test_after_a_restart_a_recording_goes_on_where_it_was(tmp_path):
    given = []

    def opened(_, journal):
        given.append(journal.earlier)
        return Listed([[replace(read, recording="b")] for (read,) in reads(0, 4 + 4 * (len(given) - 1))])

    request = made.Ready(tmp_path / "none", made.calibration())
    for _ in range(2):
        Service(tmp_path, request, SETTINGS, opened).run(lambda _: None)
    assert given[0] is None
    assert (given[1].recordings, given[1].last) == (frozenset({"b"}), "b")
    assert given[1].since_unix_s > 1.7e9
    assert [one["exposure"] for one in lines(tmp_path)[0]] == [0, 1, 2, 3]


def test_a_ring_that_is_made_anew_loses_no_exposure(tmp_path):
    anew = [Notice("made anew", counts_anew=True)]
    service(tmp_path, [*reads(1000, 1004), anew, *reads(0, 4)]).run(lambda _: None)
    records, events = lines(tmp_path)
    assert [one["exposure"] for one in records] == [500, 501, 0, 1]
    assert [one["reads_damaged"] for one in records] == [0] * 4
    assert "made anew" in events


def test_reads_that_no_record_tells_of_are_told_at_the_end(tmp_path):
    service(tmp_path, [*reads(100, 104), *reads(0, 3)]).run(lambda _: None)
    assert lines(tmp_path)[1][-1] == "stopped; 3 reads since the last record came too late or twice"


def test_frames_that_stop_and_come_again_are_told_once_each(tmp_path, monkeypatch):
    clock = iter(range(0, 100_000, 2))
    monkeypatch.setattr(service_module.time, "monotonic", lambda: float(next(clock)))
    monkeypatch.setattr(service_module, "CLOCK_STEP_S", 1e9)
    arrivals = [*reads(0, 4), *[[]] * 60, *reads(4, 8)]
    service(tmp_path, arrivals, silent_after_s=50.0).run(lambda _: None)
    _, events = lines(tmp_path)
    assert sum(event.startswith("no frames for 50 s") for event in events) == 1
    assert sum(event.startswith("frames come again after") for event in events) == 1


def test_of_many_faults_some_are_told_and_the_rest_counted(tmp_path):
    junk = [[Fault(f"junk {number}")] for number in range(500)]
    service(tmp_path, [*junk, *reads(0, 2)]).run(lambda _: None)
    records, events = lines(tmp_path)
    told = [event for event in events if event.startswith("junk")]
    assert told == [f"junk {number}" for number in range(20)]
    assert "480 more faults, the last: junk 499" in events
    assert records[0]["reads_damaged"] == 500


def test_what_is_unforeseen_in_a_measurement_is_an_event(tmp_path, monkeypatch):
    def broken(*_):
        raise IndexError("out of range")

    monkeypatch.setattr(type(made.calibration().sensor), "measurement", broken)
    service(tmp_path, reads(0, 4)).run(lambda _: None)
    records, events = lines(tmp_path)
    assert [one["reasons"] for one in records] == [["failed"]] * 2
    assert "exposure 1 could not be measured: IndexError: out of range" in events


def test_a_wild_counter_is_an_event_and_no_number_of_missing_reads(tmp_path):
    wild = [[replace(made.read(2 + number, 30.0, reads=2), counter=2**62 + number)] for number in range(2)]
    service(tmp_path, [*reads(0, 2), *wild]).run(lambda _: None)
    records, events = lines(tmp_path)
    assert records[1]["reads_missing"] == 0
    assert f"the counter of the recorder went on to {2**62}" in events


def test_the_socket_gets_events_as_well_as_records(tmp_path):
    path = tmp_path / "s"
    heard = []

    class Connected(Listed):
        def poll(self, timeout_s):
            if not heard:
                client = socket.socket(socket.AF_UNIX)
                client.connect(str(path))
                heard.append(client)
            return super().poll(timeout_s)

    request = made.Ready(tmp_path, made.calibration())
    source = Connected([[], [Fault("frame 5 is damaged")], *reads(0, 2)])
    Service(tmp_path / "loop", request, SETTINGS, lambda *_: source, socket=path).run(lambda _: None)
    sent = [json.loads(line) for line in heard[0].recv(100_000).decode().splitlines()]
    assert [one.get("event", one.get("sequence")) for one in sent] == ["frame 5 is damaged", 1, "stopped"]


def test_frames_that_are_not_those_of_the_calibration_are_refused(tmp_path):
    class Foreign(Listed):
        acquisition = replace(made.calibration().acquisition, spectrum=((2200.0, 1.0),))

    class OfAnotherInstrument(Listed):
        instrument_name = "nirc2_narrow"

    request = made.Ready(tmp_path, made.calibration())
    for source, words in ((Foreign([]), "2200 nm"), (OfAnotherInstrument([]), "nirc2_narrow, not irlos")):
        with pytest.raises(InputDataError, match=words):
            Service(tmp_path / "loop", request, SETTINGS, lambda *_, one=source: one).run(lambda _: None)


def test_frames_exposed_otherwise_are_told(tmp_path):
    class Longer(Listed):
        acquisition = replace(made.calibration().acquisition, exposure_s=4.0)

    found = made.calibration()
    found = replace(found, acquisition=replace(found.acquisition, exposure_s=1.0))
    request = made.Ready(tmp_path, found)
    Service(tmp_path / "loop", request, SETTINGS, lambda *_: Longer([])).run(lambda _: None)
    assert (
        "frames exposed otherwise than the calibration says: exposure_s 4, not 1"
        in lines(tmp_path / "loop")[1]
    )


# -- clocks, counters and pixels that are not those of now ---------------------------------------------


def dated(counter: int, ahead_s: float):
    return replace(made.read(counter, 30.0, reads=2), unix_s=time.time() + ahead_s)


def test_a_read_of_the_future_is_named_and_those_after_it_are_measured(tmp_path):
    wild = [[dated(10**5 + number, 3600.0)] for number in range(2)]
    service(tmp_path, [*reads(0, 2), *wild, *reads(2, 8)]).run(lambda _: None)
    records, events = lines(tmp_path)
    assert [one["exposure"] for one in records] == [0, 1, 2, 3]
    assert all(one["valid"] for one in records)
    assert sum("dated 3600 s ahead of the clock of the loop; not used" in event for event in events) == 2


@pytest.mark.parametrize("seconds", [-3.15e8, -1e10, 5e6])
def test_a_clock_that_is_set_puts_no_read_into_the_future(tmp_path, monkeypatch, seconds):
    real, calls = service_module.time.time, iter(range(10**6))
    monkeypatch.setattr(service_module.time, "time", lambda: real() + seconds * (next(calls) > 20))
    arrivals = [[dated(counter, max(seconds, 0.0) * (counter > 20))] for counter in range(20)]
    service(tmp_path, arrivals).run(lambda _: None)
    assert [one["valid"] for one in lines(tmp_path)[0]] == [True] * 10


def test_reads_that_only_come_late_are_silence(tmp_path, monkeypatch):
    clock = iter(range(0, 100_000, 2))
    monkeypatch.setattr(service_module.time, "monotonic", lambda: float(next(clock)))
    monkeypatch.setattr(service_module, "CLOCK_STEP_S", 1e9)
    old = [[replace(made.read(counter, 30.0, reads=2), unix_s=0.0)] for counter in range(60)]
    service(tmp_path, [*reads(100, 104), *old], silent_after_s=50.0).run(lambda _: None)
    assert any(event.startswith("no frames for 50 s; ") for event in lines(tmp_path)[1])


def test_frozen_pixels_command_nothing_and_are_named(tmp_path):
    frozen = [[replace(made.read(7, 30.0, reads=2), counter=counter)] for counter in range(8, 14)]
    service(tmp_path, [*reads(0, 8), *frozen, *reads(14, 18)]).run(lambda _: None)
    records, events = lines(tmp_path)
    assert [one["reasons"] for one in records] == [[]] * 4 + [["frozen"]] * 3 + [[]] * 2
    assert len({one["offset_nm"] for one in records[3:7]}) == 1
    assert sum("the detector is frozen" in event for event in events) == 3


def test_a_loop_whose_offsets_nothing_answers_stops_and_says_so(tmp_path):
    service(tmp_path, reads(0, 40)).run(lambda _: None)
    records, events = lines(tmp_path)
    assert sum("the loop is not closed: offsets are not answered" in event for event in events) == 1
    held = [one for one in records if one["held"] == "open"]
    assert len(held) >= 5 and held == records[-len(held) :]
    assert not any(one["commanded"] for one in held)
    assert abs(records[-1]["offset_nm"]) < 250.0


def test_old_frames_command_nothing_where_that_is_asked_for_but_in_a_shadow(tmp_path):
    asked = replace(SETTINGS, stale_frames_s=900.0)
    service(tmp_path / "a", reads(0, 2), settings=asked).run(lambda _: None)
    assert lines(tmp_path / "a")[0][0]["reasons"] == ["old"]
    service(tmp_path / "b", reads(0, 2), settings=replace(asked, shadow=True)).run(lambda _: None)
    assert lines(tmp_path / "b")[0][0]["valid"]
    service(tmp_path / "c", [[dated(0, -60.0)], [dated(1, -60.0)]], settings=asked).run(lambda _: None)
    assert lines(tmp_path / "c")[0][0]["valid"]


def test_a_calibration_of_the_future_is_as_stale_as_one_of_the_past(tmp_path):
    settings = replace(SETTINGS, stale_after_s=86400.0)
    early = [[replace(read, unix_s=made.MADE_UNIX_S - 1e6)] for (read,) in reads(0, 2)]
    service(tmp_path, early, settings=settings).run(lambda _: None)
    assert lines(tmp_path)[0][0]["reasons"] == ["stale_calibration"]
