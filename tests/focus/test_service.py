"""The program around the loop. Truth: the reads that were given to it, and the loop by itself."""

import re
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers import focus_loop as made

from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.conventions.errors import ExitCode, InputDataError, Locked
from irlos_pipe.focus import service as service_module
from irlos_pipe.focus.calibration import CalibrationWatch
from irlos_pipe.focus.mailbox import Mailbox
from irlos_pipe.focus.service import LoopSettings, Service
from irlos_pipe.focus.source import Fault

SETTINGS = LoopSettings(ControllerSettings(gain=0.5, delay=0), reads=2)
lines = made.lines


def served(output: Path, arrivals: list, settings: LoopSettings = SETTINGS, **changes) -> list[str]:
    return made.served(output, made.Listed(arrivals), settings, **changes)


def reads(first: int, last: int, defocus_nm: float = 30.0, **changes) -> list[list]:
    """Two reads per exposure, one poll each."""
    found = [made.read(counter, defocus_nm, reads=2) for counter in range(first, last)]
    return [[replace(read, **changes)] for read in found]


def at_once(first: int, last: int) -> list[list]:
    return [[read for (read,) in reads(first, last)]]


def nan(counter: int):
    return made.read(counter, 0.0, image_e=np.full(made.WINDOW, np.nan, np.float32))


def test_every_exposure_has_a_record_and_the_command_is_that_of_the_last(tmp_path):
    said = served(tmp_path, reads(0, 8))
    records, events = lines(tmp_path)
    assert [one["exposure"] for one in records] == [0, 1, 2, 3]
    assert events == ["started, calibration first", "stopped"] == said
    command = Mailbox(tmp_path / "command").read()
    assert (command.number, command.offset_nm, command.counter) == (4, records[-1]["offset_nm"], 6)


@pytest.mark.parametrize(
    "changes", [{"every_exposure_counts": True}, {"settings": replace(SETTINGS, shadow=True)}]
)
def test_in_a_replay_or_a_shadow_every_exposure_counts(tmp_path, changes):
    served(tmp_path, at_once(0, 8), **changes)
    assert [one["valid"] for one in lines(tmp_path)[0]] == [True] * 4


def test_what_is_damaged_is_named_and_the_offset_held(tmp_path):
    served(tmp_path, [*reads(0, 4), [Fault("frame 5 is damaged")], [nan(5)], [nan(6)], *reads(7, 10)])
    records, events = lines(tmp_path)
    assert "frame 5 is damaged" in events
    assert records[2]["reads_damaged"] == 1
    assert records[2]["reasons"] == ["not_finite"]
    offsets = [one["offset_nm"] for one in records]
    assert offsets[1] == offsets[2] == offsets[3]  # the fourth holds a read that is no number, too
    assert offsets[4] != offsets[3]


@pytest.mark.parametrize(
    ("foreign", "words"),
    [
        ({"window": (20, 24)}, r"20x24 px.*32x32"),
        ({"instrument_name": "nirc2_narrow"}, "nirc2_narrow, not irlos"),
    ],
    ids=["window", "instrument"],
)
def test_a_source_whose_frames_are_not_those_of_the_calibration_is_refused(tmp_path, foreign, words):
    source = made.Listed([])
    for name, value in foreign.items():
        setattr(source, name, value)
    with pytest.raises(InputDataError, match=words):
        made.served(tmp_path, source, SETTINGS)


def test_two_loops_on_one_output_are_refused(tmp_path):
    class First(made.Listed):
        def poll(self, timeout_s):
            with pytest.raises(Locked) as caught:
                served(tmp_path, [])
            assert caught.value.exit_code == ExitCode.LOCKED

    made.served(tmp_path, First([]), SETTINGS)


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
    watch = CalibrationWatch(Changing(tmp_path, found), made.calibration())
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
    assert news is new is watch.current


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
    assert watch.current.name == "first"
    assert re.search(words, news)


# -- recordings, rings and faults -----------------------------------------------------------------------


def test_after_a_restart_a_recording_goes_on_where_it_was(tmp_path):
    given = []

    def opened(_, journal):
        given.append(journal.earlier)
        return made.Listed(reads(0, 4 * len(given), recording="b"))

    for _ in range(2):
        request = made.Ready(tmp_path / "none", made.calibration())
        Service(tmp_path, request, SETTINGS, opened).run(lambda _: None)
    assert given[0] is None
    assert (given[1].recordings, given[1].last) == (frozenset({"b"}), "b")
    assert given[1].since_unix_s > 1.7e9
    assert [one["exposure"] for one in lines(tmp_path)[0]] == [0, 1, 2, 3]


@pytest.fixture
def two_seconds_a_look(monkeypatch):
    clock = iter(range(0, 100_000, 2))
    monkeypatch.setattr(service_module.time, "monotonic", lambda: float(next(clock)))
    monkeypatch.setattr(service_module, "CLOCK_STEP_S", 1e9)


def test_frames_that_stop_and_come_again_are_told_once_each(tmp_path, two_seconds_a_look):
    said = served(tmp_path, [*reads(0, 4), *[[]] * 60, *reads(4, 8)], silent_after_s=50.0)
    assert sum(line.startswith("no frames for 50 s") for line in said) == 1
    assert sum(line.startswith("frames come again after") for line in said) == 1


# -- clocks and pixels that are not those of now, a focus that does not answer -----------------------------


def dated(counter: int, ahead_s: float) -> list:
    return [replace(made.read(counter, 30.0, reads=2), unix_s=time.time() + ahead_s)]


@pytest.mark.parametrize("seconds", [3600.0, -3.15e8, -1e10, 5e6])
def test_a_clock_that_is_set_is_noted_and_puts_no_read_into_the_future(tmp_path, monkeypatch, seconds):
    arrivals = [dated(counter, 0.0) for counter in range(20)]
    real, calls = service_module.time.time, iter(range(10**6))
    monkeypatch.setattr(service_module.time, "time", lambda: real() + seconds * (next(calls) > 20))
    served(tmp_path, arrivals)
    records, events = lines(tmp_path)
    assert [one["valid"] for one in records] == [True] * 10
    assert sum(event == f"the clock was set by {seconds:+.1f} s" for event in events) == 1


def test_frozen_pixels_command_nothing_and_are_named(tmp_path):
    frozen = [[replace(made.read(7, 30.0, reads=2), counter=counter)] for counter in range(8, 14)]
    served(tmp_path, [*reads(0, 8), *frozen, *reads(14, 18)])
    records, events = lines(tmp_path)
    assert [one["reasons"] for one in records] == [[]] * 4 + [["frozen"]] * 3 + [[]] * 2
    assert len({one["offset_nm"] for one in records[3:7]}) == 1
    assert sum("the detector is frozen" in event for event in events) == 3


def test_a_loop_whose_offsets_nothing_answers_stops_and_says_so(tmp_path):
    served(tmp_path, reads(0, 40))
    records, events = lines(tmp_path)
    assert sum("the loop is not closed: offsets are not answered" in event for event in events) == 1
    held = [one for one in records if one["held"] == "open"]
    assert len(held) >= 5 and held == records[-len(held) :]
    assert not any(one["commanded"] for one in held)
    assert abs(records[-1]["offset_nm"]) < 250.0


@pytest.mark.parametrize(
    ("arrivals", "shadow", "reasons"),
    [(reads(0, 2), False, ["old"]), (reads(0, 2), True, []), ([dated(0, -60.0), dated(1, -60.0)], False, [])],
    ids=["old", "old in a shadow", "of a minute ago"],
)
def test_old_frames_command_nothing_where_that_is_asked_for(tmp_path, arrivals, shadow, reasons):
    served(tmp_path, list(arrivals), replace(SETTINGS, stale_frames_s=900.0, shadow=shadow))
    assert lines(tmp_path)[0][0]["reasons"] == reasons


def test_a_wild_counter_is_an_event_and_no_number_of_missing_reads(tmp_path):
    wild = [[replace(made.read(2 + number, 30.0, reads=2), counter=2**62 + number)] for number in range(2)]
    served(tmp_path, [*reads(0, 2), *wild])
    records, events = lines(tmp_path)
    assert records[1]["reads_missing"] == 0
    assert f"the counter of the recorder went on to {2**62}" in events


def test_a_read_of_the_future_is_named_and_those_after_it_are_measured(tmp_path):
    wild = [dated(10**5 + number, 3600.0) for number in range(2)]
    served(tmp_path, [*reads(0, 2), *wild, *reads(2, 8)])
    records, events = lines(tmp_path)
    assert [(one["exposure"], one["valid"]) for one in records] == [(n, True) for n in range(4)]
    assert sum("dated 3600 s ahead of the clock of the loop; not used" in event for event in events) == 2
