"""The files between the processes. Truth: what was written; damage done by hand."""

import numpy as np
import pytest
from helpers import focus_loop as made

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.mailbox import Command, Mailbox
from irlos_pipe.focus.ring import RingSource, RingWriter, window_of
from irlos_pipe.focus.source import Fault


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ring"


def read(counter: int, window=(3, 4)):
    return made.read(counter, 0.0, image_e=np.full(window, counter, np.float32))


def test_frames_come_out_as_they_went_in(path):
    writer = RingWriter(path, (3, 4), 8)
    source = RingSource(path)
    writer.write(read(5))
    writer.write(read(6))
    first, second = source.poll(0.0)
    assert (first.counter, second.counter, first.unix_s) == (5, 6, read(5).unix_s)
    np.testing.assert_array_equal(second.image_e, np.full((3, 4), 6.0))
    assert source.poll(0.0) == []
    assert window_of(path) == (3, 4)


def test_a_writer_that_was_killed_goes_on_and_a_reader_sees_what_is_still_there(path):
    for counter in range(5):
        writer = RingWriter(path, (3, 4), 8)  # every frame by another process
        writer.write(read(counter))
        writer.close()
    assert [one.counter for one in RingSource(path).poll(0.0)] == list(range(5))


def test_frames_that_were_overwritten_are_counted(path):
    writer = RingWriter(path, (3, 4), 8)
    source = RingSource(path)
    for counter in range(20):
        writer.write(read(counter))
    fault, *rest = source.poll(0.0)
    assert isinstance(fault, Fault)
    assert "13 frames overwritten" in fault.text
    assert [one.counter for one in rest] == list(range(13, 20))


def test_a_damaged_frame_is_named_and_the_next_one_read(path):
    writer = RingWriter(path, (3, 4), 8)
    writer.write(read(1))
    writer.write(read(2), damaged=True)
    writer.write(read(3))
    first, fault, third = RingSource(path).poll(0.0)
    assert (first.counter, third.counter) == (1, 3)
    assert "frame 2 is damaged" in fault.text


@pytest.mark.parametrize("content", [b"", b"IRLOSRNG", b"SIMPLE  = T" * 40, b"IRLOSRNG" + b"\xff" * 200])
def test_another_file_is_refused(path, content):
    path.write_bytes(content)
    with pytest.raises(InputDataError, match="ring"):
        RingSource(path)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_the_last_command_stands_in_the_mailbox_and_is_always_a_number(tmp_path, value):
    box = Mailbox(tmp_path / "command")
    assert box.read() is None
    box.write(Command(3, -12.5, 4000))
    with pytest.raises(ValueError, match="offset"):
        box.write(Command(4, value, 4001))
    box.close()
    assert Mailbox(tmp_path / "command").read() == Command(3, -12.5, 4000)


def test_a_damaged_command_is_none_and_another_file_is_refused(tmp_path):
    box = Mailbox(tmp_path / "command")
    box.write(Command(3, -12.5, 4000))
    content = bytearray((tmp_path / "command").read_bytes())
    content[18] ^= 1
    (tmp_path / "command").write_bytes(content)
    assert box.read() is None
    (tmp_path / "other").write_text("something else")
    with pytest.raises(InputDataError, match="not the command"):
        Mailbox(tmp_path / "other")


# -- what can happen to the file of a ring ----------------------------------------------------------


def looked(source: RingSource) -> list:
    """What comes when it looks at its file."""
    source._looked_s = -1e9
    return list(source.poll(0.0))


def remade(path, window=(3, 4)) -> RingWriter:
    path.unlink()
    return RingWriter(path, window, 8)


@pytest.mark.parametrize("window", [(3, 4), (5, 6)])
def test_a_ring_that_is_made_anew_is_read_from_its_beginning(path, window):
    writer = RingWriter(path, (3, 4), 8)
    source = RingSource(path)
    writer.write(read(100))
    assert len(source.poll(0.0)) == 1
    writer.write(read(101))
    other = remade(path, window)
    other.write(read(0, window))
    rest, notice = looked(source)
    assert rest.counter == 101
    assert f"frames of {window[0]}x{window[1]} px" in notice.text and notice.counts_anew
    (first,) = source.poll(0.0)
    assert (first.counter, first.image_e.shape) == (0, window)
