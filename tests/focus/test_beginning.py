"""What a loop that is started again begins with. Truth: the command that an earlier loop has left."""

import json

import pytest
from helpers import focus_loop as made

from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.mailbox import Command, Mailbox
from irlos_pipe.focus.service import LoopSettings

SETTINGS = LoopSettings(ControllerSettings(gain=0.5, delay=0))


def ran(output, first: int, last: int, settings=SETTINGS) -> list[str]:
    return made.served(output, made.Listed([[made.read(n, 40.0)] for n in range(first, last)]), settings)


def command(output) -> Command:
    box = Mailbox(output / "command")
    found = box.read()
    box.close()
    assert found is not None
    return found


@pytest.fixture
def left(tmp_path):
    ran(tmp_path, 0, 4)
    return tmp_path


def goes_on(output, before: Command) -> list[str]:
    """The next exposure follows the offset that stood, under the next number."""
    said = ran(output, 10, 11)
    after = command(output)
    assert after.number == before.number + 1
    assert after.offset_nm == pytest.approx(before.offset_nm + 0.5 * 40.0, abs=3.0)
    return said


def lines(output) -> list[bytes]:
    return (output / "focus.jsonl").read_bytes().splitlines(True)


@pytest.mark.parametrize("kept", [0, 1, 3, 5], ids=lambda kept: f"{kept} lines kept")
def test_whatever_is_lost_of_the_record_the_offset_that_stands_is_kept(left, kept):
    before = command(left)
    (left / "focus.jsonl").write_bytes(b"".join(lines(left)[:kept]))
    said = goes_on(left, before)
    assert (f"no record; goes on from command 4, {before.offset_nm:.1f} nm" in said) == (kept < 2)


@pytest.mark.parametrize("value", [1e6, None, "text", float("inf")], ids=repr)
def test_a_forged_offset_is_not_believed(left, value):
    before = command(left)
    content = lines(left)
    content[4] = json.dumps(json.loads(content[4]) | {"offset_nm": value}).encode() + b"\n"
    (left / "focus.jsonl").write_bytes(b"".join(content))
    goes_on(left, before)


def test_where_the_end_of_the_record_and_the_command_are_lost_it_refuses(left):
    (left / "command").unlink()
    (left / "focus.jsonl").write_bytes(b"".join(lines(left)[:4]) + b"rubbish\n")
    with pytest.raises(InputDataError, match=r"offset that stands is not known.*another output"):
        ran(left, 10, 11)


def test_a_lost_or_damaged_command_is_no_matter_where_the_record_is_whole(left):
    before = command(left)
    content = bytearray((left / "command").read_bytes())
    content[20] ^= 1
    (left / "command").write_bytes(content)
    assert "the command is damaged" in ran(left, 10, 10)
    (left / "command").unlink()
    goes_on(left, before)


def test_an_offset_beyond_the_limit_is_refused(left):
    narrow = LoopSettings(ControllerSettings(gain=0.5, delay=0, limit_nm=30.0))
    with pytest.raises(InputDataError, match="beyond --limit-nm 30"):
        ran(left, 10, 11, narrow)
