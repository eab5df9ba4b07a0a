"""The record on disk. Truth: the records that were added; disks filled by a limit on the size of files."""

import json
import resource
import sqlite3
from contextlib import contextmanager

import pytest
from helpers import focus_loop as made

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.journal import Journal, Record, record_of


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return made.records(6)


def lines(folder) -> list[str]:
    return (folder / "focus.jsonl").read_text().splitlines()


def rows(folder) -> list[int]:
    with sqlite3.connect(folder / "focus.sqlite") as connection:
        return [number for (number,) in connection.execute("SELECT sequence FROM records ORDER BY sequence")]


def recorded(folder, records) -> bytes:
    journal = Journal(folder)
    for record in records:
        journal.add(record)
    journal.close()
    return (folder / "focus.jsonl").read_bytes()


def found(folder, content: bytes) -> Journal:
    (folder / "focus.jsonl").write_bytes(content)
    journal = Journal(folder)
    journal.close()
    return journal


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


def test_whatever_byte_of_the_last_line_is_damaged_the_last_sound_record_is_found(tmp_path, records):
    content = recorded(tmp_path, records[:3])
    begin = content.rindex(b"\n", 0, -1) + 1
    for position in range(begin, len(content) - 1, 7):
        damaged = content[:position] + b"\xff" + content[position + 1 :]
        journal = found(tmp_path, damaged)
        assert (journal.last, journal.damaged) == (records[1], 1)


def test_wherever_the_file_ends_the_last_whole_record_is_found(tmp_path, records):
    content = recorded(tmp_path, records[:4])
    first = content.index(b"\n") + 1
    for end in range(first, len(content), 97):
        journal = found(tmp_path, content[:end])
        assert journal.last == records[content[:end].count(b"\n") - 1]
        assert journal.damaged == (not content[:end].endswith(b"\n"))


@pytest.mark.parametrize("value", [None, "12", [1.0], {"a": 1}, float("nan"), float("inf")], ids=repr)
@pytest.mark.parametrize("key", ["offset_nm", "sequence", "exposure", "counter", "settling", "mode"])
def test_a_record_from_which_no_loop_can_go_on_is_left_out(tmp_path, records, key, value):
    content = recorded(tmp_path, records[:2])
    forged = json.loads(records[2].line()) | {key: value}
    assert found(tmp_path, content + json.dumps(forged).encode() + b"\n").last == records[1]
    assert rows(tmp_path) == [1, 2]


def test_damaged_lines_in_the_middle_are_left_out_everywhere(tmp_path, records):
    lines_of = recorded(tmp_path, records).splitlines(True)
    lines_of[2] = b'{"schema": "irlos-focus", "unix_s": [' + b"[" * 100_000 + b"\n"
    (tmp_path / "focus.sqlite").unlink()
    (tmp_path / "focus.jsonl").write_bytes(b"".join(lines_of))
    journal = Journal(tmp_path)
    assert journal.last == records[-1]
    assert len(journal.recent(0.0)) == 5
    assert journal.earlier is not None
    journal.close()
    assert rows(tmp_path) == [1, 2, 4, 5, 6]


def test_a_database_of_noise_or_of_another_shape_is_set_aside_and_made_anew(tmp_path, records):
    content = recorded(tmp_path, records)
    for number, harm in enumerate((noise, another_shape), 1):
        harm(tmp_path / "focus.sqlite")
        before = (tmp_path / "focus.sqlite").read_bytes()
        journal = found(tmp_path, content)
        assert f"focus.sqlite.damaged-{number}" in journal.news()
        assert (tmp_path / f"focus.sqlite.damaged-{number}").read_bytes() == before
        Journal(tmp_path).close()
        assert rows(tmp_path) == [1, 2, 3, 4, 5, 6]


def noise(path) -> None:
    path.write_bytes(b"no database at all" * 100)


def another_shape(path) -> None:
    path.unlink()
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE thesis (chapter TEXT)")


def test_a_locked_database_is_left_alone_told_of_and_filled_later(tmp_path, records):
    recorded(tmp_path, records[:2])
    with sqlite3.connect(tmp_path / "focus.sqlite", isolation_level=None) as other:
        other.execute("BEGIN EXCLUSIVE")
        journal = Journal(tmp_path)
        journal.add(records[2])
        assert "locked" in journal.news()
        other.execute("ROLLBACK")
    journal.close()
    assert "up to date again" in journal.news()
    assert rows(tmp_path) == [1, 2, 3]


def test_a_link_is_not_followed(tmp_path, records):
    other = tmp_path / "other.sqlite"
    other.touch()
    output = tmp_path / "loop"
    output.mkdir()
    (output / "focus.sqlite").symlink_to(other)
    recorded(output, records)
    assert other.read_bytes() == b""
    assert [record_of(line) for line in lines(output)] == records
    (output / "focus.jsonl").rename(output / "elsewhere")
    (output / "focus.jsonl").symlink_to("elsewhere")
    with pytest.raises(InputDataError, match="cannot be opened"):
        Journal(output)


@pytest.mark.parametrize("content", ["something else\n", '{"a": 1}\n', "no end of line"])
def test_another_file_is_refused_and_left_alone(tmp_path, content):
    (tmp_path / "focus.jsonl").write_text(content)
    with pytest.raises(InputDataError, match="not the record"):
        Journal(tmp_path)
    assert (tmp_path / "focus.jsonl").read_text() == content
