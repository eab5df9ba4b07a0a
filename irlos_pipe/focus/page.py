"""The live page: the last hour of a loop in a browser.

It listens on the loopback address and nowhere else, unless an address is named together with a token.
"""

from __future__ import annotations

import hmac
import ipaddress
import threading
from collections import deque
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from urllib.parse import parse_qs, urlsplit

from irlos_pipe.conventions.errors import ConfigurationError

HOUR = 3600  # records kept
LOOPBACK = "127.0.0.1"
SHORTEST_TOKEN = 16


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
        self._lines: deque[tuple[int, str]] = deque(maxlen=HOUR)
        handler = partial(_Handler, lines=self._lines, settings=settings)
        try:
            self._server = ThreadingHTTPServer((settings.address, settings.port), handler)
        except OSError as error:
            raise ConfigurationError(
                f"--page-port {settings.port}: cannot listen on {settings.address}: {error.strerror}"
            ) from None
        self._server.daemon_threads = True
        self.url = f"http://{settings.address}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def show(self, sequence: int, line: str) -> None:
        """Add the `line` of the record with that `sequence`."""
        self._lines.append((sequence, line))

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    """Answers ``/`` with the page and ``/records?after=N`` with the records after number N."""

    def __init__(self, *arguments, lines: deque[tuple[int, str]], settings: PageSettings):
        self._lines, self._settings = lines, settings
        super().__init__(*arguments)

    def do_GET(self) -> None:
        """Answer a request."""
        url = urlsplit(self.path)
        query = parse_qs(url.query)
        if not self._is_own_host() or not self._is_allowed(query):
            self.send_error(HTTPStatus.FORBIDDEN)
        elif url.path == "/":
            self._answer(
                "text/html; charset=utf-8", files("irlos_pipe.focus").joinpath("live.html").read_bytes()
            )
        elif url.path == "/records":
            self._answer("application/json", self._records(query))
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _records(self, query: dict[str, list[str]]) -> bytes:
        after = query.get("after", ["0"])[0]
        last = int(after) if after.isdecimal() else 0
        lines = [line for sequence, line in list(self._lines) if sequence > last]
        return f"[{','.join(lines)}]".encode()

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
