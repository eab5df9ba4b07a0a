"""Where a product comes from: software, machine, time and command."""

import os
import platform
import socket
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import irlos_pipe

GIT_TIMEOUT_S = 5.0
PACKAGES = ("torch", "numpy", "scipy", "astropy", "h5py", "pydantic")


@cache
def software_versions() -> dict[str, str]:
    """Return the versions of irlos_pipe, Python and the packages that numbers depend on.

    That of irlos_pipe has the git revision behind it where it runs from a checkout.
    """
    revision = _git_revision(Path(irlos_pipe.__file__).parents[1])
    own = f"{irlos_pipe.__version__}+{revision}" if revision else irlos_pipe.__version__
    found = {"irlos_pipe": own, "python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _git_revision(checkout: Path) -> str:
    """Return ``git.`` and the short revision, ``.dirty`` behind it with changes; nothing without git."""
    if not (checkout / ".git").exists():  # a package that is installed, perhaps in somebody else's checkout
        return ""
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty=.dirty", "--match="]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=GIT_TIMEOUT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return f"git.{answer.stdout.strip()}"


def machine() -> dict[str, Any]:
    return {"host": socket.gethostname(), "platform": platform.platform(), "pid": os.getpid()}


def now() -> str:
    """Return the UTC time in ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def command_line() -> str:
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
