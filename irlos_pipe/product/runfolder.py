"""The folder of a run: its file names, its lock, and its tidiness."""

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from filelock import FileLock, SoftFileLock, Timeout

import irlos_pipe
from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, IrlosError, Locked
from irlos_pipe.conventions.text import and_more
from irlos_pipe.files.atomic import has_locks, remove_leftovers, write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.files.regular import read_regular
from irlos_pipe.files.yaml import load_yaml

LOG = logging.getLogger(__name__)
LOCK_NAME = ".lock"
SOFT_LOCK_NAME = ".lock.soft"  # a file that is there while a run owns the folder
PARTIAL = ".partial"
EARLIER = "earlier"
OF_A_RUN = ("recipe.resolved.yaml",)
OF_THE_SYSTEM = "lost+found"

NAME = ".standing.json"
REWRITTEN = ("run.log", "report.html")  # files that may change at any time; nothing depends on them
SIBLING_OF = "_PIX"  # a folder NAME_PIX is read together with NAME
MOST_FILES = 20000  # to list; more take longer than a plan


class _Named:
    """A file or folder of a run by its name: its path."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, run: "RunFolder", kind: object = None) -> Path:
        return run.path / self._name


@dataclass(frozen=True)
class RunFolder:
    path: Path

    results = _Named("results.json")  # of all stages, for scripts
    quality = _Named("qc.json")  # all QC checks, for scripts
    report = _Named("report.html")  # for people
    figures = _Named("figures")  # of the report as files, where they were asked for
    log = _Named("run.log")  # what happened, run after run
    recipe = _Named("recipe.resolved.yaml")  # with every default made explicit

    @property
    def product_files(self) -> list[Path]:
        """All products that are there, whoever made them, by name; those of the run are `products`."""
        return sorted(self.path.glob("[0-9][0-9]_*.h5"))

    def product(self, position: int, stage: str) -> Path:
        """Return the path of the product of `stage` at a `position` in the recipe, counted from 1."""
        return self.path / f"{position:02d}_{stage}.h5"

    def set_aside(self, names: Iterable[str]) -> None:
        """Move files that are no longer those of the run to the folder ``earlier``.

        Raises `IrlosError` when they cannot be moved.
        """
        for path in [path for name in names if (path := self.path / name).is_file()]:
            self._move_to_earlier(path)

    def set_figures_aside(self) -> None:
        """Move figures that are no longer those of the run as well."""
        if self.figures.is_dir() and not self.figures.is_symlink():
            shutil.rmtree(self.path / EARLIER / self.figures.name, ignore_errors=True)
            self._move_to_earlier(self.figures)

    def _move_to_earlier(self, path: Path) -> None:
        try:
            (self.path / EARLIER).mkdir(exist_ok=True)
            os.replace(path, self.path / EARLIER / path.name)
        except OSError as error:
            raise IrlosError(f"{path}: cannot be moved: {error.strerror or error}") from error

    def scratch(self, stage: str, key: str) -> Path:
        """Return where `stage` keeps finished parts of the product of that `key`; it is not made here."""
        return self.path / PARTIAL / f"{stage}-{key[:16]}"

    def remove_scratch(self, stage: str) -> None:
        """Remove the parts that a stage kept, those of other keys as well."""
        for folder in (self.path / PARTIAL).glob(f"{stage}-*"):
            shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # absent, or another stage's parts are in it
            (self.path / PARTIAL).rmdir()

    def products(self) -> dict[str, Path]:
        """Return the products behind results.json, by stage; none from other recipes or earlier settings.

        Raises `InputDataError` when results.json cannot be read.
        """
        stages = load_yaml(self.recipe, InputDataError)[0]["stages"]
        try:
            reported = set(json.loads(read_regular(self.results))["stages"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputDataError(f"{self.results}: cannot be read ({error}); run the recipe again") from error
        numbered = enumerate(stages, 1)
        return {stage: self.product(number, stage) for number, stage in numbered if stage in reported}


def existing_run(folder: Path) -> RunFolder:
    """Return the folder of an earlier run; `InputDataError` when no run ever used this folder."""
    run = RunFolder(Path(folder))
    if not run.recipe.is_file():
        runs = [path.parent for path in run.path.glob(f"*/{run.recipe.name}")]  # the last by name is `latest`
        advice = f"give a run in it, {max(runs)}" if runs else "make one with: irlos run RECIPE --output DIR"
        raise InputDataError(f"{folder}: not the folder of a run (no {run.recipe.name}); {advice}")
    return run


def require_outside_inputs(folder: Path, inputs: Mapping[str, Iterable[Path]]) -> None:
    """Refuse an output `folder` inside one of the `inputs`: its products would count as input data.

    Raises `ConfigurationError` when it lies there.
    """
    for name, roots in inputs.items():
        for root in roots:
            if Path(os.path.realpath(folder)).is_relative_to(os.path.realpath(root)):
                raise ConfigurationError(
                    f"--output {folder}: lies inside input '{name}' ({root}); choose a folder elsewhere"
                )


def require_free(folder: Path, own: Iterable[str] = OF_A_RUN) -> None:
    """Refuse an output `folder` with files in it that no command of this kind made; it need not exist.

    A folder in which one of the patterns `own` matches is one of our own.

    Raises `ConfigurationError` when it has other files, or is a file.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ConfigurationError(f"--output {folder}: is a file; give a folder")
    there = {entry.name for entry in folder.iterdir() if not entry.name.startswith(".")}
    foreign = sorted(there - {RunFolder(folder).log.name, OF_THE_SYSTEM})
    if foreign and not any(next(folder.glob(pattern), None) for pattern in own):
        raise ConfigurationError(
            f"--output {folder}: holds other files ({foreign[0]}{and_more(foreign)}); give a new or an empty "
            "folder"
        )


@contextmanager
def owned_folder(path: Path) -> Iterator[RunFolder]:
    """Make the folder if need be and own it until the block ends.

    Where the file system has no locks, a file stands for the lock.

    Raises `Locked` when another run owns it, and `IrlosError` when it cannot be made or written.
    """
    if (path / LOCK_NAME).is_symlink():
        raise IrlosError(f"{path / LOCK_NAME}: a link, which is not followed; remove it")
    advice = "wait for it or choose another --output"
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock: FileLock | SoftFileLock = FileLock(path / LOCK_NAME, timeout=0)
        if not has_locks(path):
            lock = SoftFileLock(path / SOFT_LOCK_NAME, timeout=0)
            LOG.warning("%s: this disk has no locks; %s keeps other runs away", path, SOFT_LOCK_NAME)
            advice += f"; if it was killed, remove {path / SOFT_LOCK_NAME} (this disk has no locks)"
        lock.acquire()
        if (path / PARTIAL).is_symlink():  # what is kept and removed there must lie here
            (path / PARTIAL).unlink()
    except Timeout:
        raise Locked(f"{path}: in use by another run; {advice}") from None
    except OSError as error:
        raise IrlosError(f"{path}: cannot be written: {error.strerror or error}") from error
    try:
        remove_leftovers(path)
        yield RunFolder(path)
    finally:
        lock.release()


class _CannotTell(Exception):
    """What a run depends on lies beyond what a stamp lists."""


def inputs_stamp(inputs: Iterable[Path]) -> str:
    """Return the stamp of the files under `inputs` and next to them; empty where it is not known."""
    try:
        return _digest(line for root in sorted(inputs) for line in _around(root))
    except (OSError, _CannotTell):
        return ""


def listing_stamp(root: Path) -> str:
    """Return the stamp of all that decides which files are read of an input; empty where it is not known."""
    inputs = inputs_stamp([root])
    return _digest([_package_stamp(), inputs]) if inputs else ""


def remember_standing(run: RunFolder, inputs: str) -> None:
    """Note that all products of a `run` are up to date with `inputs`, a stamp made before they were read."""
    stamp = _stamp(run)
    if stamp and stamp["inputs"] == inputs:
        write_bytes(run.path / NAME, json_text(stamp).encode())


def is_standing(run: RunFolder) -> bool:
    """Return whether all products of a `run` are up to date for sure."""
    try:
        noted = json.loads((run.path / NAME).read_text())
    except (OSError, ValueError, RecursionError):
        return False
    return bool(noted) and noted == _stamp(run)


def _stamp(run: RunFolder) -> dict[str, str]:
    """Stamps by what they are of; empty where they are not known."""
    try:
        recipe = load_yaml(run.recipe)[0]
        package = Path(irlos_pipe.__file__).parent
        if not (package / "instrument" / f"{recipe['instrument']}.yaml").is_file():
            return {}  # a profile of somebody's own may name further files
        paths = [Path(path) for given in recipe["inputs"].values() for path in given]
        inputs = inputs_stamp(paths)
        own = (entry for entry in _entries(run.path) if entry.name not in REWRITTEN)
        parts: dict[str, Any] = {
            "package": _package_stamp(),
            "run": _digest(_line(entry) for entry in own if not entry.is_dir()),
            "inputs": inputs,
        }
    except (OSError, IrlosError, KeyError, AttributeError, TypeError, _CannotTell):
        return {}
    return parts if inputs else {}


@cache
def _package_stamp() -> str:
    return _digest(_below(Path(irlos_pipe.__file__).parent))


def _digest(lines: Iterable[str]) -> str:
    found = hashlib.sha256()
    for number, line in enumerate(lines):
        if number > MOST_FILES:
            raise _CannotTell
        found.update(line.encode(errors="surrogateescape") + b"\0")
    return found.hexdigest()


def _around(root: Path) -> Iterator[str]:
    """What lies under a file or folder given as input, and next to a file."""
    if root.is_dir():
        yield from _below(root)
    else:
        yield from (_line(entry) for entry in _entries(root.parent) if not entry.is_dir())
    for folder in (root, root.parent):
        if folder.name.endswith(SIBLING_OF):
            yield from _below(folder.with_name(folder.name.removesuffix(SIBLING_OF)))


def _below(folder: Path) -> Iterator[str]:
    for entry in _entries(folder) if folder.is_dir() else ():
        if entry.is_dir():
            if entry.is_symlink():
                raise _CannotTell
            if entry.name != "__pycache__":
                yield from _below(Path(entry.path))
        else:
            yield _line(entry)


def _entries(folder: Path) -> list[os.DirEntry]:
    """Entries of a folder in a fixed order; hidden ones are read by nobody."""
    with os.scandir(folder) as entries:
        return sorted((one for one in entries if not one.name.startswith(".")), key=lambda one: one.name)


def _line(entry: os.DirEntry) -> str:
    status = entry.stat()
    return f"{entry.path} {status.st_size} {status.st_mtime_ns}"
