"""What can go wrong with the record, the command and the database of a loop, and with those who connect."""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from benchmarks.focus_faults.judging import Verdict
from benchmarks.focus_faults.rig import GAIN, Rig, outcome_of, run
from benchmarks.focus_faults.sky import Skies
from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.files.json import jsonable
from irlos_pipe.focus.calibration import Calibration
from irlos_pipe.focus.live import LivePage, PageSettings, Publisher
from irlos_pipe.focus.mailbox import BODY, MAGIC, Command, Mailbox
from irlos_pipe.focus.record import event_line

FILES = "files"
EXPOSURES = 12
Harm = Callable[[Path], None]


def file_cases() -> Iterator[tuple[str, bool, Harm]]:
    """Yield name, whether it is of a kind that was asked for, and what is done to the output of a loop."""
    for tenths in range(10):
        yield f"a byte changed at {tenths} tenths of the last record", True, _byte(-1, tenths / 10)
        yield f"the record cut at {tenths} tenths of the last line", True, _cut(tenths / 10)
    for tenths in (0, 3, 6, 9):
        yield f"a byte changed at {tenths} tenths of a middle record", True, _byte(5, tenths / 10)
        yield f"the record cut at {tenths} tenths of the whole", True, _cut_whole(tenths / 10)
    for position in range(0, BODY.size + 4, 4):
        yield f"byte {position} of the command changed", True, _command_byte(position)
    for name, value in {
        "null": None,
        "1e6": 1e6,
        "text": "12",
        "-1e308": -1e308,
        "a list": [1],
        "true": True,
    }.items():
        yield f"offset of the last record {name}", True, _last(offset_nm=value)
    yield "number of the last record 1e30", False, _last(sequence=10**30)
    yield "mode of the last record unknown", False, _last(mode="warp")
    yield "reasons of the last record null", False, _last(reasons=None)
    yield "100 000 events after the last record", True, _events(100_000)
    yield "record deleted", True, lambda output: (output / "focus.jsonl").unlink()
    yield "command deleted", True, lambda output: (output / "command").unlink()
    yield "database deleted", False, lambda output: (output / "focus.sqlite").unlink()
    yield "database of noise", True, lambda output: _database(output, b"no database" * 1000)
    yield "database of another shape", True, _another_shape
    yield "database is a link", True, _linked
    yield "a line of a megabyte of brackets", False, _append(b"[" * 10**6 + b"\n")
    yield "a line that is not of the record", False, _append(b'{"a": 1}\n')
    yield "a line of zeros, as after a crash of the machine", False, _append(b"\0" * 5000 + b"\n")
    yield "zeros without an end", False, _append(b"\0" * 200_000)


def judge_file(
    name: str, known: bool, harm: Harm, skies: Skies, calibration: Calibration, output: Path
) -> Verdict:
    """Run a loop, harm what it has left, and run it again: the offset must survive, or a refusal say why."""
    seed = zlib.crc32(f"{skies.seed}.{name}".encode())
    run(_rig(skies, seed), calibration, output)
    last = outcome_of(output, []).records[-1]
    harm(output)
    problem = ""
    try:
        again = _rig(skies, seed, last)
        records = _run_again(again, calibration, output)
    except (InputDataError, ConfigurationError) as refusal:
        problem = "" if str(output) in str(refusal) else f"refused without a path: {refusal}"
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
    else:
        problem = _discontinuity(last, records)
    return Verdict(f"{FILES}.{name}", FILES, name, known, problem=problem)


class _Again(Rig):
    """Goes on with the counters, the time and the offset of an earlier loop."""

    first = 0


def _rig(skies: Skies, seed: int, last: dict | None = None) -> _Again:
    rig = _Again(skies, 12.0, seed, before=EXPOSURES, spell=0, after=0)
    if last is not None:
        rig._index, rig._exposures = EXPOSURES, 2 * EXPOSURES
        rig.drift_nm = np.full(2 * EXPOSURES + 1, last["offset_nm"])
        rig.clock.passed_s, rig._applied_nm = 60.0, last["offset_nm"]
        rig._commanded_nm = [last["offset_nm"]] * len(rig._commanded_nm)
        rig.first = last["counter"] + 1
    return rig


def _run_again(rig: _Again, calibration: Calibration, output: Path) -> list[dict]:
    """Records with counters that the first run did not have."""
    found = run(rig, calibration, output).records
    return [one for one in found if one["counter"] >= rig.first]


def _discontinuity(last: dict, records: list[dict]) -> str:
    """What is not as if nothing had happened: numbers go on, and the first step is an ordinary one."""
    if len(records) < EXPOSURES - 1:
        return f"only {len(records)} records after the restart"
    first = records[0]
    step_nm = abs(first["offset_nm"] - last["offset_nm"])
    if step_nm > GAIN * abs(first["defocus_nm"]) + 60.0 or abs(first["defocus_nm"]) > 100.0:
        return f"a step of {step_nm:.0f} nm from {last['offset_nm']:.0f} nm"
    return (
        ""
        if first["sequence"] > last["sequence"] - 1
        else f"number {first['sequence']} after {last['sequence']}"
    )


def _lines(output: Path) -> list[bytes]:
    return (output / "focus.jsonl").read_bytes().splitlines(True)


def _index(lines: list[bytes], which: int) -> int:
    return [number for number, line in enumerate(lines) if b'"sequence"' in line][which]


def _byte(which: int, part: float) -> Harm:
    def harm(output: Path) -> None:
        lines = _lines(output)
        number = _index(lines, which)
        line = bytearray(lines[number])
        line[int(part * (len(line) - 2))] ^= 0x80
        lines[number] = bytes(line)
        (output / "focus.jsonl").write_bytes(b"".join(lines if which >= 0 else lines[: number + 1]))
        (output / "focus.sqlite").unlink()

    return harm


def _cut(part: float) -> Harm:
    def harm(output: Path) -> None:
        lines = _lines(output)
        number = _index(lines, -1)
        kept = lines[number][: int(part * len(lines[number]))]
        (output / "focus.jsonl").write_bytes(b"".join(lines[:number]) + kept)

    return harm


def _cut_whole(part: float) -> Harm:
    def harm(output: Path) -> None:
        path = output / "focus.jsonl"
        os.truncate(path, int(part * path.stat().st_size))

    return harm


def _command_byte(position: int) -> Harm:
    def harm(output: Path) -> None:
        content = bytearray((output / "command").read_bytes())
        content[position] ^= 0x41
        (output / "command").write_bytes(content)

    return harm


def _last(**values: object) -> Harm:
    def harm(output: Path) -> None:
        lines = _lines(output)
        number = _index(lines, -1)
        lines[number] = json.dumps(json.loads(lines[number]) | values).encode() + b"\n"
        (output / "focus.jsonl").write_bytes(b"".join(lines))

    return harm


def _append(content: bytes) -> Harm:
    def harm(output: Path) -> None:
        with open(output / "focus.jsonl", "ab") as stream:
            stream.write(content)

    return harm


def _events(count: int) -> Harm:
    return _append(event_line(EXPOSURES, 0.0, "ring: frame 1000 is damaged").encode() * count)


def _database(output: Path, content: bytes) -> None:
    for name in ("focus.sqlite-wal", "focus.sqlite-shm"):
        (output / name).unlink(missing_ok=True)
    (output / "focus.sqlite").write_bytes(content)


def _another_shape(output: Path) -> None:
    (output / "focus.sqlite").unlink()
    with sqlite3.connect(output / "focus.sqlite") as connection:
        connection.execute("CREATE TABLE records (a INTEGER)")


def _linked(output: Path) -> None:
    (output / "focus.sqlite").rename(output.parent / f"{output.name}.other.sqlite")
    (output / "focus.sqlite").symlink_to(output.parent / f"{output.name}.other.sqlite")


# -- those who connect --------------------------------------------------------------------------------


def visitor_cases() -> Iterator[tuple[str, Callable[[Path], str]]]:
    """Yield name and trial of visitors; a trial returns what is not as asked."""
    for request in ("http://[::bad/", "//[", "/lines?after=%ff", "/" + "a" * 60_000, "/\udcff"):
        yield f"request for {request[:20]!r}", partial(_requested, request, "localhost")
    yield "host [", partial(_requested, "/", "[")
    yield "100 connections that say nothing", _crowd
    yield "socket of a living loop", _second_socket
    yield "command of no number", _no_number


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


def judge_visitor(name: str, trial: Callable[[Path], str], output: Path) -> Verdict:
    """Let somebody connect."""
    output.mkdir(parents=True)
    try:
        problem = trial(output)
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
    return Verdict(f"visitors.{name}", "visitors", name, True, problem=str(jsonable(problem)))
