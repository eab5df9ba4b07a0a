"""Log messages of a run: to run.log, and those of each stage into its product."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from pathlib import Path

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.files.regular import own_file

ROOT = logging.getLogger("irlos_pipe")
RUN = ROOT.getChild("run")
"""What the run does; shown on the terminal."""
TRACE = ROOT.getChild("trace")
"""What went wrong inside; for the file, since the terminal shows it as an error of its own."""
WARNINGS = logging.getLogger("py.warnings")


@contextmanager
def written_to(path: Path) -> Iterator[None]:
    """Append all messages of the package, and Python warnings, to a file while the block lasts.

    Raises `IrlosError` when the file cannot be opened.
    """
    try:
        handler = _FileHandler(path, encoding="utf-8")
    except OSError as error:
        raise IrlosError(f"{path}: cannot be written: {error.strerror}") from error
    level = ROOT.level
    ROOT.setLevel(level or logging.INFO)
    logging.captureWarnings(True)
    try:
        with _attached(ROOT, handler), _attached(WARNINGS, handler):
            yield
    finally:
        logging.captureWarnings(False)
        ROOT.setLevel(level)
        with suppress(OSError):
            handler.close()


@contextmanager
def collected(logger: logging.Logger) -> Iterator[list[str]]:
    """Collect the messages of a logger as lines ``LEVEL message`` while the block lasts."""
    handler = _ListHandler()
    with _attached(logger, handler):
        yield handler.lines


@contextmanager
def _attached(logger: logging.Logger, handler: logging.Handler) -> Iterator[None]:
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


class _FileHandler(logging.FileHandler):
    """Keeps quiet when the disk is full: the product that cannot be written says so, once."""

    def __init__(self, path: Path, encoding: str) -> None:
        super().__init__(path, encoding=encoding)
        line = "%(asctime)sZ %(levelname)-7s %(name)s: %(message)s"
        formatter = logging.Formatter(line, "%Y-%m-%dT%H:%M:%S")
        formatter.converter = time.gmtime
        self.setFormatter(formatter)

    def _open(self) -> TextIOWrapper:
        name = self.baseFilename
        return open(name, "a", encoding="utf-8", errors="backslashreplace", opener=own_file)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (name given by logging)
        pass


class _ListHandler(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(f"{record.levelname} {record.getMessage()}")
