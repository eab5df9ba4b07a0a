"""The live page: the last hour of a loop in a browser.

It listens on the loopback address and nowhere else, unless an address is named together with a token.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import secrets
import threading
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from urllib.parse import parse_qs, urlsplit

from irlos_pipe.conventions.errors import ConfigurationError

HOUR_S = 3600.0  # of lines that are kept
MOST_LINES = 40_000  # kept, of exposures of a tenth of a second an hour
LOOPBACK = "127.0.0.1"
SHORTEST_TOKEN = 16
LONGEST_NUMBER = 16  # digits
MOST_CONNECTIONS, CONNECTION_S = 20, 10.0  # at once, and how long one may say nothing


@dataclass(frozen=True)
class PageSettings:
    """Where the page is.

    Attributes
    ----------
    port : int
        0 takes a free one.
    address : str
        To listen on.
    token : str
        That requests must carry, empty for none.

    Raises
    ------
    ConfigurationError
        For an address beyond the loopback without a token.
    """

    port: int
    address: str = LOOPBACK
    token: str = ""

    def __post_init__(self) -> None:
        try:
            beyond = not ipaddress.ip_address(self.address).is_loopback
        except ValueError:
            raise ConfigurationError(f"--page-address {self.address}: give an IP address") from None
        if beyond and len(self.token) < SHORTEST_TOKEN:
            raise ConfigurationError(
                f"--page-address {self.address}: reachable from other machines, which needs a token of at "
                f"least {SHORTEST_TOKEN} characters in IRLOS_FOCUS_TOKEN"
            )


class LivePage:
    """Serves the page from a thread of its own.

    Parameters
    ----------
    settings : PageSettings

    Raises
    ------
    ConfigurationError
        If the port cannot be had.
    """

    def __init__(self, settings: PageSettings):
        self._kept = _Kept()
        handler = partial(_Handler, kept=self._kept, settings=settings)
        try:
            self._server = _Server((settings.address, settings.port), handler)
        except OSError as error:
            raise ConfigurationError(
                f"--page-port {settings.port}: cannot listen on {settings.address}: {error.strerror}"
            ) from None
        self.url = f"http://{settings.address}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def show(self, line: str, written_unix_s: float | None = None) -> None:
        """Add the line of a record or an event.

        Parameters
        ----------
        line : str
        written_unix_s : float, optional
            When it was written; by default just now.
        """
        self._kept.add(line, time.time() if written_unix_s is None else written_unix_s)

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    """Serves few at once; who comes beyond that, or breaks off, is no event."""

    daemon_threads = True

    def __init__(self, *arguments):
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__(*arguments)

    def process_request(self, request, client_address) -> None:
        """Answer a connection in a thread of its own, or close it where there are too many."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request, client_address) -> None:
        """Answer a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request, client_address) -> None:
        """A client that breaks off or sends rubbish is none of the loop's business."""


class _Kept:
    """The lines of the last hour, numbered from 1, under a name: a page may stay open beyond the loop."""

    def __init__(self) -> None:
        self._name, self._number = secrets.token_hex(8), 0
        self._lines: deque[tuple[int, float, str]] = deque(maxlen=MOST_LINES)

    def add(self, line: str, written_unix_s: float) -> None:
        """Add a line; those of more than an hour before it go."""
        self._number += 1
        self._lines.append((self._number, written_unix_s, line))
        while written_unix_s - self._lines[0][1] > HOUR_S:
            self._lines.popleft()

    def after(self, number: int, name: str) -> str:
        """Return as JSON the lines after a number, all of them if they were numbered under another name."""
        kept, known = list(self._lines), number if name == self._name else 0
        head = json.dumps({"loop": self._name, "last": kept[-1][0] if kept else 0, "now": time.time()})
        lines = ",".join(line for position, _, line in kept if position > known)
        return f'{head[:-1]}, "lines": [{lines}]}}'


class _Handler(BaseHTTPRequestHandler):
    """Answers ``/`` with the page, ``/lines?after=N&loop=NAME`` with lines after number N of that name."""

    timeout = CONNECTION_S

    def __init__(self, *arguments, kept: _Kept, settings: PageSettings):
        self._kept, self._settings = kept, settings
        super().__init__(*arguments)

    def do_GET(self) -> None:
        """Answer a request."""
        try:
            url = urlsplit(self.path)
            query = parse_qs(url.query)
            allowed = self._is_own_host() and self._is_allowed(query)
        except ValueError:
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        if not allowed:
            self.send_error(HTTPStatus.FORBIDDEN)
        elif url.path == "/":
            self._answer(
                "text/html; charset=utf-8", files("irlos_pipe.focus").joinpath("live.html").read_bytes()
            )
        elif url.path == "/lines":
            self._answer("application/json", self._lines(query))
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _lines(self, query: dict[str, list[str]]) -> bytes:
        after = query.get("after", ["0"])[0]
        number = int(after) if after.isdecimal() and len(after) < LONGEST_NUMBER else 0
        return self._kept.after(number, query.get("loop", [""])[0]).encode()

    def _is_own_host(self) -> bool:
        """A page of another site that leads a browser here by name is not answered."""
        if self._settings.token:
            return True
        host = urlsplit(f"//{self.headers.get('Host', '')}").hostname or ""
        return host in (self._settings.address, "localhost")

    def _is_allowed(self, query: dict[str, list[str]]) -> bool:
        given = query.get("token", [""])[0]
        return hmac.compare_digest(given.encode(), self._settings.token.encode())

    def _answer(self, kind: str, content: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", "default-src 'self' 'unsafe-inline'; img-src 'none'")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *arguments: object) -> None:
        """Requests are not logged."""
