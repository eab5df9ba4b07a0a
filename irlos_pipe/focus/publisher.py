"""Records as they come, for other programs of this machine: a Unix socket that gives every client each line.

It is a file that only its owner may open; no port is involved. Clients that do not keep up are dropped.
"""

from __future__ import annotations

import os
import socket
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError

LONGEST_PATH = 100  # a limit of the system


class Publisher:
    """Sends lines to whoever has connected.

    Parameters
    ----------
    path : Path
        Of the socket; one that an earlier loop left behind is replaced.

    Raises
    ------
    ConfigurationError
        If it cannot be made there.
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
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            client.setblocking(False)
            self._clients.append(client)
