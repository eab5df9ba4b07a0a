"""Where a product comes from: software, machine, time and command."""

from __future__ import annotations

import os
import platform
import socket
import sys
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import irlos_pipe

PACKAGES = ("torch", "numpy", "scipy", "astropy", "h5py", "pydantic")


@cache
def software_versions() -> dict[str, str]:
    """Versions of irlos_pipe, Python and the packages that numbers depend on."""
    found = {"irlos_pipe": irlos_pipe.__version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, Any]:
    """The computer the software runs on."""
    return {"host": socket.gethostname(), "platform": platform.platform(), "pid": os.getpid()}


def now() -> str:
    """UTC time in ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def command_line() -> str:
    """The command that started this process."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
