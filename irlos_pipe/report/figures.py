"""Every figure of a report as a file of its own, for papers and slides."""

import io
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.report.build import report_sections
from irlos_pipe.report.drawing import ALONE, kept_by
from irlos_pipe.report.run_data import read_run

Kept = TypeVar("Kept")
FORMATS = ("pdf", "png", "svg")
PNG_DPI = 200
# Text as outlines in SVG, which looks the same everywhere, and as text in PDF, which can be edited.
FONTS: dict[Any, Any] = {"svg.fonttype": "path", "pdf.fonttype": 42}
NO_DATE = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {}}


def write_figures(run: RunFolder, formats: Sequence[str] = FORMATS) -> list[Path]:
    """Write all figures of the report of a `run`, owned by the caller, into ``figures``, replacing others.

    Returns the files, in the order of the report. Raises `InputDataError` when a product cannot be read;
    `IrlosError` when a file cannot be written.
    """
    if run.figures.is_symlink():
        raise IrlosError(f"{run.figures}: a link, through which nothing is written; remove it")
    drawn = _drawn(run.path, lambda figure: {kind: _file(figure, kind) for kind in formats})
    run.set_figures_aside()
    try:
        run.figures.mkdir(exist_ok=True)
    except OSError as error:
        raise IrlosError(f"{run.figures}: cannot be made: {error.strerror or error}") from error
    files = {run.figures / f"{name}.{kind}": one[kind] for name, one in drawn.items() for kind in formats}
    for path, content in files.items():
        write_bytes(path, content)
    return list(files)


def figures(path: Path | str) -> dict[str, Figure]:
    """Return every figure of the report of a finished run by name, for notebooks, papers and slides.

    Raises `InputDataError` when it is not the folder of a run, or a product cannot be read.
    """
    return _drawn(Path(path), lambda figure: figure)


def figure(path: Path | str, name: str, axes: Axes | None = None) -> FigureBase:
    """Return one of `figures` by its `name`, or draw it on `axes` and return theirs; see `Run.figure`."""
    met: list[str] = []
    token = ALONE.set((name, axes, met))
    try:
        drawn = _drawn(Path(path), lambda one: one)
    finally:
        ALONE.reset(token)
    if name not in met:
        raise ConfigurationError(f"no figure '{name}'{suggestion(name, met)}")
    return next(iter(drawn.values())) if axes is None else axes.figure


def _drawn(folder: Path, kept: Callable[[Figure], Kept]) -> dict[str, Kept]:
    """What is `kept` of every figure of the report of a run, by name."""
    drawn: dict[str, Kept] = {}

    def keep(name: str, figure: Figure) -> None:
        drawn[_unused(name, drawn)] = kept(figure)

    with kept_by(keep):
        report_sections(read_run(folder))
    return drawn


def _unused(name: str, taken: Collection[str]) -> str:
    """The name of a drawing, numbered where there are several."""
    plain = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)
    count = sum(other == plain or other.rpartition("-")[0] == plain for other in taken)
    return plain if plain not in taken else f"{plain}-{count + 1}"


def _file(figure: Figure, kind: str) -> bytes:
    stream = io.BytesIO()
    with rc_context(FONTS):
        figure.savefig(stream, format=kind, facecolor="white", dpi=PNG_DPI, metadata=NO_DATE[kind])
    return stream.getvalue()
