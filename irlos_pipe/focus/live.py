"""Who may look at a loop: the live page, the last hour in a browser; and a Unix socket with every line.

The page listens on the loopback address and nowhere else, unless an address is named together with a token.
The socket is a file that only its owner may open; no port is involved.
"""

import hmac
import ipaddress
import json
import os
import secrets
import socket
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from irlos_pipe.conventions.errors import ConfigurationError

HOUR_S = 3600.0  # age of the lines that are kept
MOST_LINES = 40_000  # lines that are kept: an hour of exposures of a tenth of a second
LOOPBACK = "127.0.0.1"
SHORTEST_TOKEN = 16  # characters
LONGEST_NUMBER = 16  # digits of a line's number in a request
MOST_CONNECTIONS, CONNECTION_S = 20, 10.0  # connections at once, and how long one may say nothing
LONGEST_PATH = 100  # bytes of a socket's path, a limit of the system
MOST_CLIENTS = 50  # clients at once; of more, those that came first are dropped


@dataclass(frozen=True)
class PageSettings:
    """Where the page is: a port, 0 for a free one; an address; a token that requests carry, empty for none.

    Raises `ConfigurationError` for an address beyond the loopback without a token.
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

    It keeps the lines of the last hour, numbered from 1, under a name: a page may stay open beyond the loop.

    Raises `ConfigurationError` if the port cannot be had.
    """

    def __init__(self, settings: PageSettings):
        self._name, self._number = secrets.token_hex(8), 0
        self._lines: deque[tuple[int, float, str]] = deque(maxlen=MOST_LINES)
        handler = partial(_Handler, page=self, settings=settings)
        try:
            self._server = _Server((settings.address, settings.port), handler)
        except OSError as error:
            raise ConfigurationError(
                f"--page-port {settings.port}: cannot listen on {settings.address}: {error.strerror}"
            ) from None
        self.url = f"http://{settings.address}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def show(self, line: str, written_unix_s: float | None = None) -> None:
        """Add a `line`, written just now or at `written_unix_s`; those of more than an hour before it go."""
        self._number += 1
        written_unix_s = time.time() if written_unix_s is None else written_unix_s
        self._lines.append((self._number, written_unix_s, line))
        while written_unix_s - self._lines[0][1] > HOUR_S:
            self._lines.popleft()

    def after(self, number: int, name: str) -> str:
        """Return as JSON the lines after a `number`, all if they were numbered under another `name`."""
        kept, known = list(self._lines), number if name == self._name else 0
        head = json.dumps({"loop": self._name, "last": kept[-1][0] if kept else 0, "now": time.time()})
        lines = ",".join(line for position, _, line in kept if position > known)
        return f'{head[:-1]}, "lines": [{lines}]}}'

    def close(self) -> None:
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
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request, client_address) -> None:
        """A client that breaks off or sends rubbish is none of the loop's business."""


class _Handler(BaseHTTPRequestHandler):
    """Answers ``/`` with the page, ``/lines?after=N&loop=NAME`` with lines after number N of that name."""

    timeout = CONNECTION_S

    def __init__(self, *arguments, page: LivePage, settings: PageSettings):
        self._page, self._settings = page, settings
        super().__init__(*arguments)

    def do_GET(self) -> None:
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
            page = files("irlos_pipe.focus").joinpath("live.html").read_bytes()
            self._answer("text/html; charset=utf-8", page)
        elif url.path == "/lines":
            after = query.get("after", ["0"])[0]
            number = int(after) if after.isdecimal() and len(after) < LONGEST_NUMBER else 0
            lines = self._page.after(number, query.get("loop", [""])[0])
            self._answer("application/json", lines.encode())
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

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


class Publisher:
    """Sends lines to whoever has connected to a socket; clients that do not keep up are dropped.

    A socket that an earlier loop left behind is replaced.

    Raises `ConfigurationError` if it cannot be made there, or another loop listens there.
    """

    def __init__(self, path: Path):
        self._path, self._clients = path, list[socket.socket]()
        problem = ""
        if len(os.fsencode(path)) > LONGEST_PATH:
            problem = "the path is too long for a socket; choose a shorter one"
        elif path.exists() and not path.is_socket():
            problem = "there is another file; remove it or choose another name"
        elif _is_taken(path):
            problem = "another loop listens there; choose another name"
        if problem:
            raise ConfigurationError(f"--socket {path}: {problem}")
        path.unlink(missing_ok=True)
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(0o177)
        try:
            self._server.bind(os.fspath(path))
        except OSError as error:
            raise ConfigurationError(f"--socket {path}: {error.strerror}") from None
        finally:
            os.umask(before)
        self._server.listen()
        self._server.setblocking(False)
        self._inode = os.stat(path).st_ino

    def send(self, line: str) -> None:
        self._accept()
        content = line.encode()
        for client in list(self._clients):
            try:
                complete = client.send(content) == len(content)
            except OSError:
                complete = False
            if not complete:
                self._clients.remove(client)
                client.close()

    def close(self) -> None:
        for one in (*self._clients, self._server):
            one.close()
        with suppress(OSError):
            if os.stat(self._path).st_ino == self._inode:  # not that of another loop
                self._path.unlink()

    def _accept(self) -> None:
        for _ in range(MOST_CLIENTS):
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            client.setblocking(False)
            self._clients.append(client)
            if len(self._clients) > MOST_CLIENTS:
                self._clients.pop(0).close()


def _is_taken(path: Path) -> bool:
    """Whether somebody listens at a socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(1.0)
        try:
            client.connect(os.fspath(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # it is there and busy, or may not be opened
            return True
    return True
