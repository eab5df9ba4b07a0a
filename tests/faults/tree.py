"""What a tree of results holds: what must be the same after any fault, and what must never be seen."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.product.runfolder import LOCK_NAME
from irlos_pipe.product.storage import read_product

DATABASE = "trend.sqlite"
TABLES = ("recordings", "runs", "numbers")
# Whole, but with times of the run in them: only their presence and their end are looked at.
TIMED = (".html", ".log")
KEPT_HIDDEN = {LOCK_NAME, ".input_checksums.json", ".standing.json"}


def content(tree: Path) -> dict[str, Any]:
    """Return all that does not depend on when it was made, by path below the tree.

    Arrays, errors, results, checks and configurations of products; the other files as bytes, but of
    reports, pages and logs only that they are there; all rows of the database.
    """
    found = {name: _content_of(path) for name, path in _visible(tree)}
    return found | {f"{DATABASE}:{table}": _rows(tree / DATABASE, table) for table in TABLES}


def broken(tree: Path) -> list[str]:
    """Return what is there to be seen and is not whole."""
    problems = [f"{name}: {problem}" for name, path in _visible(tree) if (problem := _problem(path))]
    for run in _published(tree):
        if not (run / "results.json").is_file() or len(list(run.glob("*.h5"))) != 3:
            problems.append(f"{run.relative_to(tree)}: not complete")
    return problems


def leftovers(tree: Path) -> list[str]:
    """Return what a finished run should have tidied up, and locks that are still held."""
    hidden = [path for path in tree.rglob(".*") if path.name not in KEPT_HIDDEN]
    locks = [path for path in tree.rglob(LOCK_NAME) if _is_held(path)]
    return [str(path.relative_to(tree)) for path in [*hidden, *locks]]


def _published(tree: Path) -> Iterator[Path]:
    """Folders of complete reductions."""
    return (path for path in tree.glob("*/*/*") if path.is_dir() and not path.name.startswith("."))


def _visible(tree: Path) -> Iterator[tuple[str, Path]]:
    """Files that a reader of the tree comes upon, but the database."""
    for folder in (tree, *_published(tree)):
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.is_file() and not path.name.startswith((".", DATABASE)):
                yield str(path.relative_to(tree)), path


def _content_of(path: Path) -> Any:
    if path.suffix in TIMED:
        return "there"
    if path.suffix != ".h5":
        return path.read_bytes()
    product = read_product(path)
    arrays = {
        name: (one.value.tobytes(), one.unit, None if one.error is None else one.error.tobytes())
        for name, one in product.arrays.items()
    }
    return arrays, product.results, product.checks, product.config, product.provenance["key"]


def _problem(path: Path) -> str:
    if path.suffix == ".h5":
        try:
            read_product(path)
        except InputDataError as error:
            return str(error)
    if path.suffix == ".html" and not path.read_text().rstrip().endswith("</html>"):
        return "cut off"
    return ""


def _rows(path: Path, table: str) -> list[tuple]:
    with sqlite3.connect(path) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        return sorted(connection.execute(f"SELECT * FROM {table}").fetchall(), key=repr)


def _is_held(path: Path) -> bool:
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        return True
    lock.release()
    return False
