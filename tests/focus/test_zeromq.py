"""Frames over ZeroMQ. Truth: what was sent, by a publisher of the test."""

import time
from dataclasses import replace

import numpy as np
import pytest

from irlos_pipe.control.exposures import Read
from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.focus.source import Fault
from irlos_pipe.focus.zeromq import ZeroMqSource, message_of

zmq = pytest.importorskip("zmq")
TOKEN = "a token of 24 characters"


def read(counter: int):
    image_e = np.arange(12, dtype=np.float32).reshape(3, 4) + counter
    return Read(counter, time.time(), image_e)


@pytest.fixture
def publisher(tmp_path):
    context = zmq.Context()
    sender = context.socket(zmq.XPUB)  # it sees who subscribes, and waits for that
    sender.bind(f"ipc://{tmp_path}/frames")
    yield sender
    context.destroy(linger=0)


def subscribed(publisher, token: str = "") -> ZeroMqSource:
    source = ZeroMqSource(publisher.get_string(zmq.LAST_ENDPOINT), token)
    assert publisher.poll(5000)
    publisher.recv()
    return source


def arrived(source: ZeroMqSource, count: int) -> list:
    found, until = [], time.monotonic() + 10
    while len(found) < count and time.monotonic() < until:
        found += source.poll(0.2)
    source.close()
    return found


@pytest.mark.parametrize("token", ["", TOKEN])
def test_frames_come_out_as_they_went_in(publisher, token):
    source = subscribed(publisher, token)
    sent = [read(5), read(6)]
    for one in sent:
        publisher.send_multipart(message_of(one, token))
    found = arrived(source, 2)
    assert [(one.counter, one.unix_s) for one in found] == [(one.counter, one.unix_s) for one in sent]
    np.testing.assert_array_equal(found[1].image_e, sent[1].image_e)


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        (lambda parts: [b"hello"], "no frame"),
        (lambda parts: [b"SOMEFRAM" + parts[0][8:], *parts[1:]], "no frame"),
        (lambda parts: [parts[0], parts[1][:-4], parts[2]], "another version or size"),
        (lambda parts: [*parts[:2], b"x"], "not signed"),
    ],
)
def test_what_is_no_frame_is_named_and_the_next_one_read(publisher, spoilt, words):
    source = subscribed(publisher)
    publisher.send_multipart(spoilt(message_of(read(1))))
    publisher.send_multipart(message_of(read(2)))
    fault, frame = arrived(source, 2)
    assert isinstance(fault, Fault) and words in fault.text
    assert frame.counter == 2


@pytest.mark.parametrize("sent", [message_of(read(1)), message_of(read(1), "another one of 24 chars."), None])
def test_with_a_token_frames_must_be_signed_by_it(publisher, sent):
    source = subscribed(publisher, TOKEN)
    signed = message_of(read(1), TOKEN)
    changed = [signed[0], b"\0" * len(signed[1]), signed[2]]
    publisher.send_multipart(sent or changed)
    (fault,) = arrived(source, 1)
    assert "not signed with the token" in fault.text


@pytest.mark.parametrize("token", ["", "short"])
def test_no_other_machine_without_a_token(token):
    with pytest.raises(ConfigurationError, match="at least 16 characters in IRLOS_FOCUS_TOKEN"):
        ZeroMqSource("tcp://192.0.2.1:5555", token)


@pytest.mark.slow
def test_signed_frames_that_are_played_back_are_refused_however_many_they_are(publisher):
    source = subscribed(publisher, TOKEN)
    now = time.time()
    old = [message_of(replace(read(counter), unix_s=now - 3600 + counter), TOKEN) for counter in range(300)]
    new = [message_of(replace(read(counter), unix_s=now + 0.001 * counter), TOKEN) for counter in (301, 302)]
    for message in (new[0], *old, new[0], *old, new[1], new[0], new[1]):
        publisher.send_multipart(message)
    found = [one for _ in range(10) for one in source.poll(0.05)]
    source.close()
    assert [one.counter for one in found if not isinstance(one, Fault)] == [301, 302]
    assert sum(one.reads for one in found if isinstance(one, Fault)) == 603
    assert all("played back" in one.text for one in found if isinstance(one, Fault))


@pytest.mark.slow
def test_a_flood_of_junk_is_counted_and_frames_between_it_are_read(publisher):
    source = subscribed(publisher)
    for number in range(500):
        publisher.send(b"junk")
        if number % 100 == 0:
            publisher.send_multipart(message_of(read(number)))
    found = [one for _ in range(20) for one in source.poll(0.05)]
    source.close()
    assert [one.counter for one in found if not isinstance(one, Fault)] == [0, 100, 200, 300, 400]
    faults = [one for one in found if isinstance(one, Fault)]
    assert sum(one.reads for one in faults) == 500
    assert len(faults) < 100
