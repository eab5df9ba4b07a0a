"""Frames from a ZeroMQ socket: the recorder publishes, the loop subscribes and opens no port of its own.

A message has three parts, little-endian: the head (magic ``IRLOSFRM``; version, rows, columns as uint32;
4 bytes of padding; counter int64, time float64), the pixels (float32, x fastest; photo-electrons without dark
and background), and the HMAC-SHA256 of the two with the token, empty without one. Within this machine no
token is needed. Frames of another one move a mirror here: every message must be signed.
"""

import hashlib
import hmac
import ipaddress
import math
import struct
import time
from collections.abc import Sequence
from urllib.parse import urlsplit

import numpy as np

from irlos_pipe.control.exposures import Read
from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.late import LateModule
from irlos_pipe.focus.live import SHORTEST_TOKEN
from irlos_pipe.focus.source import Clock, Fault

MAGIC, VERSION = b"IRLOSFRM", 1
HEAD = struct.Struct("<8s3I4xqd")
KEPT = 1024  # messages that wait for the loop at most
LARGER = 4  # times a frame of the loop's window, above which no message is taken
REPORTED, MOST = 20, 2000  # faults of a poll that are reported each, and messages that it takes
FRESH_S = 10.0  # age of a signed message from which it may be one played back


def message_of(read: Read, token: str = "") -> list[bytes]:
    """Return the parts of the message of one `read`, signed with a `token`: for recorders."""
    pixels = np.ascontiguousarray(read.image_e, "<f4")
    parts = [HEAD.pack(MAGIC, VERSION, *pixels.shape, read.counter, read.unix_s), pixels.tobytes()]
    return [*parts, _signature(parts, token)]


class ZeroMqSource:
    """Subscribes to the frames of a recorder, of a `window` of rows and columns.

    The recorder has bound a PUB socket to the `endpoint`, ``tcp://ADDRESS:PORT`` or ``ipc://FILE``. With a
    `token` messages must be signed, newer than all before, and not older than seconds: whoever plays messages
    back has no token.

    Raises `ConfigurationError` if pyzmq is not installed, the endpoint is none, or lies beyond this machine
    and there is no token.
    """

    def __init__(self, endpoint: str, token: str = "", window: tuple[int, int] = (512, 512)):
        _require_near(endpoint, token)
        needed = "needs the package pyzmq; install it with: pip install 'irlos_pipe[zeromq]'"
        zmq = LateModule("zmq", ConfigurationError(f"--zeromq {endpoint}: {needed}"))
        self._endpoint, self._token, self._context = endpoint, token, zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.RCVHWM, KEPT)
        self._socket.set(zmq.MAXMSGSIZE, LARGER * 4 * window[0] * window[1] + 4096)
        self._socket.set(zmq.SUBSCRIBE, b"")
        failed = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
        self._strangers = self._socket.get_monitor_socket(failed)
        self._named, self._newest_s, self._clock = False, -math.inf, Clock()
        try:
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise ConfigurationError(f"--zeromq {endpoint}: {error.strerror}") from None

    def poll(self, timeout_s: float) -> Sequence[Read | Fault]:
        until = time.monotonic() + timeout_s
        found: list[Read | Fault] = self._faults()
        if not found:
            self._socket.poll(max(0, math.ceil(1e3 * (until - time.monotonic()))))
        unreported, last = 0, ""
        for _ in range(MOST):
            if not self._socket.poll(0):
                break
            one = self._frame(self._socket.recv_multipart())
            if isinstance(one, Read) or len(found) < REPORTED:
                found.append(one)
            else:
                unreported, last = unreported + 1, one.text
        if unreported:
            text = f"{last}; {unreported} of the kind at once: frames between them may be lost"
            found.append(Fault(text, unreported))
        return found

    def close(self) -> None:
        self._socket.disable_monitor()
        self._context.destroy(linger=0)

    def _faults(self) -> list[Read | Fault]:
        """Another program than a recorder at the endpoint; named once, for ZeroMQ tries again and again."""
        found: list[Read | Fault] = []
        while self._strangers.poll(0):
            self._strangers.recv_multipart()
            if not self._named:
                found.append(Fault(f"{self._endpoint}: what answers there does not speak ZeroMQ"))
            self._named = True
        return found

    def _frame(self, parts: list[bytes]) -> Read | Fault:
        if len(parts) != 3 or len(parts[0]) != HEAD.size or not parts[0].startswith(MAGIC):
            return Fault(f"{self._endpoint}: a message that is no frame")
        if not hmac.compare_digest(parts[2], _signature(parts[:2], self._token)):
            return Fault(f"{self._endpoint}: a frame that is not signed with the token of this loop")
        _, version, rows, columns, counter, unix_s = HEAD.unpack(parts[0])
        if version != VERSION or len(parts[1]) != 4 * rows * columns or not len(parts[1]):
            return Fault(f"{self._endpoint}: a frame of another version or size")
        if self._token and not (self._newest_s < unix_s and self._clock.off_s(unix_s) < FRESH_S):
            return Fault(f"{self._endpoint}: a signed frame of before, or without a time; played back?")
        self._newest_s = unix_s
        return Read(counter, unix_s, np.frombuffer(parts[1], "<f4").reshape(rows, columns))


def _signature(parts: Sequence[bytes], token: str) -> bytes:
    return hmac.new(token.encode(), b"".join(parts), hashlib.sha256).digest() if token else b""


def _require_near(endpoint: str, token: str) -> None:
    """Raise ConfigurationError for an endpoint that is none, or beyond this machine without a token."""
    try:
        url = urlsplit(endpoint)
        near = url.scheme == "ipc" or ipaddress.ip_address(url.hostname or "").is_loopback
        known = url.scheme == "ipc" or (url.scheme == "tcp" and url.port)
    except ValueError:
        known = near = False
    if not known:
        raise ConfigurationError(
            f"--zeromq {endpoint}: give tcp://ADDRESS:PORT with an IP address, or ipc://FILE"
        )
    if not near and len(token) < SHORTEST_TOKEN:
        raise ConfigurationError(
            f"--zeromq {endpoint}: another machine, whose frames must be signed with a token of at least "
            f"{SHORTEST_TOKEN} characters in IRLOS_FOCUS_TOKEN"
        )
