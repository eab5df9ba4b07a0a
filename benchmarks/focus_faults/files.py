"""What can go wrong with the record, the command and the database of a loop, and with those who connect."""

from __future__ import annotations

import json
import socket
import sqlite3
import struct
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from benchmarks.focus_faults.rig import GAIN, Rig, Skies, outcome_of, run
from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.files.json import jsonable
from irlos_pipe.focus.calibration import Calibration
from irlos_pipe.focus.journal import event_line
from irlos_pipe.focus.live import LivePage, PageSettings, Publisher
from irlos_pipe.focus.mailbox import BODY, MAGIC, Command, Mailbox

EXPOSURES = 12
RECORD, COMMAND, DATABASE = "focus.jsonl", "command", "focus.sqlite"
Harm = Callable[[Path], Any]


def file_cases() -> Iterator[tuple[str, bool, Harm]]:
    """Yield name, whether it is of a kind that was asked for, and what is done to the output of a loop."""
    for tenths in range(10):
        yield f"a byte changed at {tenths} tenths of the last record", True, _byte(-1, tenths / 10)
        cut = _line(-1, lambda line, part=tenths / 10: line[: int(part * len(line))], to_end=False)
        yield f"the record cut at {tenths} tenths of the last line", True, cut
    for tenths in (0, 3, 6, 9):
        yield f"a byte changed at {tenths} tenths of a middle record", True, _byte(5, tenths / 10)
        cut = _rewritten(RECORD, lambda content, part=tenths / 10: content[: int(part * len(content))])
        yield f"the record cut at {tenths} tenths of the whole", True, cut
    for position in range(0, BODY.size + 4, 4):
        flip = _rewritten(COMMAND, partial(_flipped, position=position, bits=0x41))
        yield f"byte {position} of the command changed", True, flip
    for name, value in (
        ("null", None),
        ("1e6", 1e6),
        ("text", "12"),
        ("-1e308", -1e308),
        ("a list", [1]),
        ("true", True),
    ):
        yield f"offset of the last record {name}", True, _last(offset_nm=value)
    yield "number of the last record 1e30", False, _last(sequence=10**30)
    yield "mode of the last record unknown", False, _last(mode="warp")
    yield "reasons of the last record null", False, _last(reasons=None)
    event = event_line(EXPOSURES, 0.0, "ring: frame 1000 is damaged").encode()
    yield "100 000 events after the last record", True, _appended(event * 100_000)
    yield "record deleted", True, lambda output: (output / RECORD).unlink()
    yield "command deleted", True, lambda output: (output / COMMAND).unlink()
    yield "database deleted", False, lambda output: (output / DATABASE).unlink()
    yield "database of noise", True, _database_of_noise
    yield "database of another shape", True, _database_of_another_shape
    yield "database is a link", True, _database_is_a_link
    yield "a line of a megabyte of brackets", False, _appended(b"[" * 10**6 + b"\n")
    yield "a line that is not of the record", False, _appended(b'{"a": 1}\n')
    yield "a line of zeros, as after a crash of the machine", False, _appended(b"\0" * 5000 + b"\n")
    yield "zeros without an end", False, _appended(b"\0" * 200_000)


def judge_file(name: str, harm: Harm, skies: Skies, calibration: Calibration, output: Path) -> str:
    """Run a loop, harm what it has left, and run it again: the offset must survive, or a refusal say why.

    Returns what is not as asked.
    """
    rig, again = (
        Rig(skies, 12.0, zlib.crc32(f"{skies.seed}.{name}".encode()), before=EXPOSURES, spell=0, after=0)
        for _ in range(2)
    )
    run(rig, calibration, output)
    last = outcome_of(output, []).records[-1]
    harm(output)
    again.go_on(last)
    try:
        records = run(again, calibration, output).records
    except (InputDataError, ConfigurationError) as refusal:
        return "" if str(output) in str(refusal) else f"refused without a path: {refusal}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return _discontinuity(last, [one for one in records if one["counter"] > last["counter"]])


def _discontinuity(last: Mapping[str, Any], records: list[dict]) -> str:
    """What is not as if nothing had happened: numbers go on, and the first step is an ordinary one."""
    if len(records) < EXPOSURES - 1:
        return f"only {len(records)} records after the restart"
    first = records[0]
    step_nm = abs(first["offset_nm"] - last["offset_nm"])
    if step_nm > GAIN * abs(first["defocus_nm"]) + 60.0 or abs(first["defocus_nm"]) > 100.0:
        return f"a step of {step_nm:.0f} nm from {last['offset_nm']:.0f} nm"
    goes_on = first["sequence"] > last["sequence"] - 1
    return "" if goes_on else f"number {first['sequence']} after {last['sequence']}"


def _rewritten(name: str, change: Callable[[bytes], bytes]) -> Harm:
    """A file with other content."""
    return lambda output: (output / name).write_bytes(change((output / name).read_bytes()))


def _appended(content: bytes) -> Harm:
    return _rewritten(RECORD, lambda before: before + content)


def _flipped(content: bytes, position: int, bits: int) -> bytes:
    changed = bytearray(content)
    changed[position] ^= bits
    return bytes(changed)


def _line(which: int, change: Callable[[bytes], bytes], to_end: bool = True) -> Harm:
    """The record with one of its lines changed, `to_end` or ending there."""

    def changed(content: bytes) -> bytes:
        lines = content.splitlines(True)
        number = [index for index, line in enumerate(lines) if b'"sequence"' in line][which]
        lines[number] = change(lines[number])
        return b"".join(lines if to_end else lines[: number + 1])

    return _rewritten(RECORD, changed)


def _byte(which: int, part: float) -> Harm:
    """A byte of a line changed, and no database that has it still."""
    changed = _line(which, lambda line: _flipped(line, int(part * (len(line) - 2)), 0x80), to_end=which >= 0)

    def harm(output: Path) -> None:
        changed(output)
        (output / DATABASE).unlink()

    return harm


def _last(**values: object) -> Harm:
    return _line(-1, lambda line: json.dumps(json.loads(line) | values).encode() + b"\n")


def _database_of_noise(output: Path) -> None:
    for name in ("focus.sqlite-wal", "focus.sqlite-shm"):
        (output / name).unlink(missing_ok=True)
    (output / DATABASE).write_bytes(b"no database" * 1000)


def _database_of_another_shape(output: Path) -> None:
    (output / DATABASE).unlink()
    with sqlite3.connect(output / DATABASE) as connection:
        connection.execute("CREATE TABLE records (a INTEGER)")


def _database_is_a_link(output: Path) -> None:
    other = output.parent / f"{output.name}.other.sqlite"
    (output / DATABASE).rename(other)
    (output / DATABASE).symlink_to(other)


# -- those who connect -------------------------------------------------------------------------


def visitor_cases() -> Iterator[tuple[str, Callable[[Path], str]]]:
    """Yield name and trial of visitors; a trial returns what is not as asked."""
    for request in ("http://[::bad/", "//[", "/lines?after=%ff", "/" + "a" * 60_000, "/\udcff"):
        yield f"request for {request[:20]!r}", partial(_requested, request, "localhost")
    yield "host [", partial(_requested, "/", "[")
    yield "100 connections that say nothing", _crowd
    yield "socket of a living loop", _second_socket
    yield "command of no number", _no_number


def judge_visitor(trial: Callable[[Path], str], output: Path) -> str:
    """Let somebody connect; returns what is not as asked."""
    output.mkdir(parents=True)
    try:
        return str(jsonable(trial(output)))
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def _requested(asked: str, host: str, folder: Path) -> str:
    page = LivePage(PageSettings(0))
    try:
        with socket.create_connection(("127.0.0.1", urlsplit(page.url).port), timeout=5) as client:
            client.sendall(f"GET {asked} HTTP/1.0\r\nHost: {host}\r\n\r\n".encode("utf-8", "surrogateescape"))
            answer = client.recv(100)
    finally:
        page.close()
    return "" if answer.split()[1:2] in ([b"400"], [b"404"], [b"414"], [b"403"], [b"200"]) else f"{answer!r}"


def _crowd(folder: Path) -> str:
    page = LivePage(PageSettings(0))
    before = threading.active_count()
    address = ("127.0.0.1", urlsplit(page.url).port)
    clients = [socket.create_connection(address, timeout=5) for _ in range(100)]
    for client in clients:
        client.sendall(b"GET / HT")
    threads = threading.active_count() - before
    for client in clients:
        client.close()
    page.close()
    return "" if threads <= 25 else f"{threads} threads"


def _second_socket(folder: Path) -> str:
    first = Publisher(folder / "s")
    try:
        Publisher(folder / "s")
    except ConfigurationError:
        return "" if (folder / "s").is_socket() else "the socket is gone"
    finally:
        first.close()
    return "taken away"


def _no_number(folder: Path) -> str:
    box = Mailbox(folder / "command")
    try:
        box.write(Command(1, float("nan"), 1))
    except ValueError:
        body = BODY.pack(MAGIC, 5, float("inf"), 1)
        (folder / "command").write_bytes(body + struct.pack("<I", zlib.crc32(body)))
        return "" if Mailbox(folder / "command").read() is None else "infinite offset was read"
    return "NaN was written"
