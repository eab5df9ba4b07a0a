"""Records as they come, for other programs of this machine: a Unix socket that gives every client each line.

It is a file that only its owner may open; no port is involved. Clients that do not keep up are dropped.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError

LONGEST_PATH = 100  # a limit of the system
MOST_CLIENTS = 50  # of more, those that came first are dropped


class Publisher:
    """Sends lines to whoever has connected.

    Parameters
    ----------
    path : Path
        Of the socket; one that an earlier loop left behind is replaced.

    Raises
    ------
    ConfigurationError
        If it cannot be made there, or another loop listens there.
    """

    def __init__(self, path: Path):
        self._path, self._clients = path, list[socket.socket]()
        if len(os.fsencode(path)) > LONGEST_PATH:
            raise ConfigurationError(
                f"--socket {path}: the path is too long for a socket; choose a shorter one"
            )
        if path.exists() and not path.is_socket():
            raise ConfigurationError(
                f"--socket {path}: there is another file; remove it or choose another name"
            )
        if _is_taken(path):
            raise ConfigurationError(f"--socket {path}: another loop listens there; choose another name")
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
        """Send a `line` to all clients."""
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
        """Close all connections and remove the socket."""
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
