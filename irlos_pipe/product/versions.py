"""Numbered versions of a reduction in one folder, and a link to the latest complete one.

::

    DIR/001  DIR/002  DIR/003     each the folder of a run
    DIR/latest -> 002             the newest one with all products of its recipe, where the disk has links
"""

from __future__ import annotations

import logging
import os
import re
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.files.json import changed_values
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.printed import VersionRow, Versions
from irlos_pipe.product.results import provenance_of, read_run_results
from irlos_pipe.product.run_table import settings_of
from irlos_pipe.product.runfolder import LOCK_NAME, OF_A_RUN, RunFolder, require_free
from irlos_pipe.product.storage import read_product

LOG = logging.getLogger(__name__)
LATEST = "latest"
NUMBER = re.compile(r"\d{3,}")
DIGITS = 3
OWN = tuple(f"[0-9][0-9][0-9]*/{name}" for name in (*OF_A_RUN, LOCK_NAME))


def version_folders(folder: Path) -> list[Path]:
    """Return the folders of the versions in a `folder`, the oldest first; links are not followed."""
    try:
        found = [path for path in folder.iterdir() if NUMBER.fullmatch(path.name) and not path.is_symlink()]
    except OSError:
        return []
    return sorted((path for path in found if path.is_dir()), key=lambda path: int(path.name))


def new_version(folder: Path) -> Path:
    """Return the folder of the version after the newest in a `folder`; it is not made here."""
    there = version_folders(folder)
    return folder / f"{(int(there[-1].name) if there else 0) + 1:0{DIGITS}d}"


def require_free_for_versions(folder: Path) -> None:
    """Refuse a `folder` with files in it that are no versions, or whose ``latest`` is no link.

    Raises `ConfigurationError` when it cannot hold versions.
    """
    require_free(folder, OWN)
    link = folder / LATEST
    if link.exists() and not link.is_symlink():
        raise ConfigurationError(f"{link}: is no link; remove it, or choose another --output")


def link_latest(folder: Path, version: Path) -> None:
    """Let ``latest`` in a `folder` lead to a `version` in it; at any moment it leads to one or the other.

    Where the link cannot be made, as on a disk without links, a warning names the version.
    """
    temporary = folder / f".{LATEST}.{os.getpid()}"
    try:
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(version.name)
        os.replace(temporary, folder / LATEST)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        LOG.warning(
            "%s: cannot be linked (%s); the newest complete version is %s",
            folder / LATEST,
            error.strerror or error,
            version,
        )


def is_complete(run: RunFolder) -> bool:
    """Return whether a `run` ended with all products of its recipe."""
    try:
        stages = load_yaml(run.recipe, InputDataError)[0]["stages"]
        results = read_run_results(run.results)
    except (InputDataError, KeyError):
        return False
    return not results.error and set(stages) <= set(results.stages)


def _latest_version(folder: Path) -> Path | None:
    """Return the newest complete version in a `folder`; None without one."""
    return next((path for path in reversed(version_folders(folder)) if is_complete(RunFolder(path))), None)


def versions_in(folder: Path) -> Versions:
    """Return what is known of the versions in a `folder`."""
    paths = version_folders(folder)
    latest = _latest_version(folder)
    pairs = zip([None, *paths], paths, strict=False)
    rows = [_row(path, before, latest=path == latest) for before, path in pairs]
    return Versions(folder=str(folder), versions=rows)


def _row(path: Path, before: Path | None, *, latest: bool) -> VersionRow:
    run = RunFolder(path)
    changed = _changed(before, path) if before else []
    if not is_complete(run):
        return VersionRow(version=path.name, status="incomplete", latest=latest, changed=changed)
    results = read_run_results(run.results)
    made = provenance_of(read_product(list(run.products().values())[-1], arrays=False))
    return VersionRow(
        version=path.name,
        recipe=results.recipe,
        status=results.status,
        latest=latest,
        finished=made.finished,
        software=made.software.get("irlos_pipe", ""),
        changed=changed,
    )


def _changed(before: Path, after: Path) -> list[str]:
    """Settings in which two versions differ; none where one of them cannot be read."""
    try:
        settings = [settings_of(RunFolder(path)) for path in (before, after)]
    except InputDataError:
        return []
    return [".".join(path) for path in changed_values(*settings)]
