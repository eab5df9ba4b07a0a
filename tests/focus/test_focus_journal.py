"""The record on disk. Truth: the records that were added; disks filled by a limit on the size of files."""

import resource
import sqlite3
from contextlib import contextmanager

import pytest
from helpers import focus_loop as made

from irlos_pipe.control.exposures import Accumulator
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.journal import Journal
from irlos_pipe.focus.loop import FocusLoop, LoopSettings
from irlos_pipe.focus.record import Record, record_of


@pytest.fixture(scope="module")
def records() -> list[Record]:
    loop, accumulator = FocusLoop(made.calibration(), LoopSettings()), Accumulator(1)
    return [loop.record(one, 0.0) for index in range(6) for one in accumulator.add(made.read(index, 20.0))]


def lines(folder) -> list[str]:
    return (folder / "focus.jsonl").read_text().splitlines()


def rows(folder) -> list[int]:
    with sqlite3.connect(folder / "focus.sqlite") as connection:
        return [number for (number,) in connection.execute("SELECT sequence FROM records ORDER BY sequence")]


@contextmanager
def full_disk(size: int):
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def test_records_and_events_are_lines_and_rows(tmp_path, records):
    journal = Journal(tmp_path)
    journal.event("started")
    for record in records:
        journal.add(record)
    journal.close()
    assert [record_of(line) for line in lines(tmp_path)] == [None, *records]
    assert rows(tmp_path) == [1, 2, 3, 4, 5, 6]


def test_a_line_cut_short_by_a_kill_is_taken_away_and_the_last_whole_one_counts(tmp_path, records):
    journal = Journal(tmp_path)
    for record in records[:3]:
        journal.add(record)
    journal.close()
    with open(tmp_path / "focus.jsonl", "a") as stream:
        stream.write(records[3].line()[:100])
    again = Journal(tmp_path)
    assert again.last == records[2]
    again.add(records[3])
    again.close()
    assert [record_of(line) for line in lines(tmp_path)] == records[:4]


def test_what_the_database_lacks_or_has_lost_comes_from_the_lines(tmp_path, records):
    journal = Journal(tmp_path)
    for record in records:
        journal.add(record)
    journal.close()
    (tmp_path / "focus.sqlite").write_bytes(b"no database at all" * 100)
    Journal(tmp_path).close()
    assert rows(tmp_path) == [1, 2, 3, 4, 5, 6]


def test_on_a_full_disk_records_wait_and_none_is_lost_or_out_of_order(tmp_path, records):
    journal = Journal(tmp_path)
    journal.add(records[0])
    size = (tmp_path / "focus.jsonl").stat().st_size
    with full_disk(size + 100):
        for record in records[1:4]:
            journal.add(record)
        assert journal.waiting == 3
        assert journal.problem
        assert len(lines(tmp_path)) == 1
    journal.add(records[4])
    assert (journal.waiting, journal.problem) == (0, "")
    journal.close()
    assert [record_of(line) for line in lines(tmp_path)] == records[:5]
    assert rows(tmp_path) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("content", ["something else\n", '{"a": 1}\n', "no end of line"])
def test_another_file_is_refused_and_left_alone(tmp_path, content):
    (tmp_path / "focus.jsonl").write_text(content)
    with pytest.raises(InputDataError, match="not the record"):
        Journal(tmp_path)
    assert (tmp_path / "focus.jsonl").read_text() == content
