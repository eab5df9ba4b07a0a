"""Build report.html: one file that needs nothing else."""

import gc
import io
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.processes import forked_map
from irlos_pipe.product.results import StageResults, provenance_of, results_of
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.report.content import Section, Text, rendered
from irlos_pipe.report.drawing import ALONE, kept_by
from irlos_pipe.report.run_data import RunData, read_run
from irlos_pipe.report.section_calibrate import calibrate_section, correct_section
from irlos_pipe.report.section_diagnose import diagnose_section, verdict_mark
from irlos_pipe.report.section_lift import lift_section, prior_section, sensitivity_section
from irlos_pipe.report.section_run import (
    answer,
    causes,
    failures,
    finished,
    ingest_section,
    key_numbers,
    meaning_section,
    origin_section,
    places_of,
    quality_section,
    warnings,
)
from irlos_pipe.report.section_series import derotator_section, modes_section
from irlos_pipe.stages import EXPERIMENTS, STAGES
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.diagnose.stage import DiagnoseResults

# Results first, in the order in which they build on one another; what went in comes behind.
SECTIONS: dict[str, Callable[[RunData], Section]] = {
    "diagnose": diagnose_section,
    "calibrate": calibrate_section,
    "correct": correct_section,
    "prior": prior_section,
    "lift": lift_section,
    "sensitivity": sensitivity_section,
    "derotator": derotator_section,
    "modes": modes_section,
    "ingest": ingest_section,
}


def write_report(run_folder: Path, jobs: int = 1) -> Path:
    """Build the report of a run, of which any stage may be missing; the same products give the same file.

    It takes up to `jobs` processes.

    Raises `InputDataError` when it is not the folder of a run, or a product cannot be read; `IrlosError` when
    the report cannot be written.
    """
    run = read_run(run_folder)
    verdict, tiles, sections = run.results(DiagnoseResults), key_numbers(run), report_sections(run, jobs)
    places = places_of(sections)
    lines = (line for product in run.products.values() for line in results_of(StageResults, product).untested)
    page = rendered(
        "report.html.j2",
        run=run,
        title=run.recipe.get("title") or run.recipe["recipe"],
        targets=", ".join(sorted({r.acquisition.target for r in run.recordings if r.acquisition.target})),
        observed=_observed(run),
        finished=finished(run),
        verdict=verdict,
        verdict_mark=verdict_mark(verdict),
        answer=answer(run),
        failures=failures(run, places),
        causes=causes(run, places),
        no_causes=run.results(CalibrateResults).no_causes,
        key_numbers=tiles,
        warnings=warnings(run),
        untested=list(dict.fromkeys(line.replace("`", "") for line in lines)),
        sections=list(filter(None, [*sections[:-1], meaning_section(tiles, sections), sections[-1]])),
    )
    path = RunFolder(Path(run_folder)).report
    write_bytes(path, page.encode())
    return path


def report_sections(run: RunData, jobs: int = 1) -> list[Section]:
    sections = (*stage_sections(run, jobs).values(), quality_section(run), origin_section(run))
    return [section for section in sections if section]


def stage_sections(run: RunData, jobs: int = 1) -> dict[str, Section]:
    """Return the section of every stage that has a product, results first; `jobs` processes draw them."""
    order = [*SECTIONS, *(stage for stage in run.products if stage not in SECTIONS)]
    stages = [stage for stage in order if stage in run.products]
    # Looking for garbage is an eighth of the work of a process that ends soon.
    drawn = forked_map(jobs, lambda stage: _section(stage, run), stages, begin=gc.disable)
    return dict(zip(stages, drawn, strict=True))


def _section(stage: str, run: RunData) -> Section:
    """Build the section of a stage; an experiment of the paper brings its own."""
    if stage in SECTIONS:
        return SECTIONS[stage](run)
    if stage in EXPERIMENTS:
        experiment: Any = STAGES[stage]
        return cast(Section, experiment.section(run))
    lines = provenance_of(run.products[stage]).summary
    return Section(stage, stage.capitalize(), blocks=[Text("\n".join(lines), verbatim=True)])


def _observed(run: RunData) -> str:
    """Return when the first and the last recording began (UTC)."""
    starts = [r.start_unix_s for r in run.recordings if np.isfinite(r.start_unix_s)]
    if not starts:
        return ""
    first, last = (datetime.fromtimestamp(start, UTC) for start in (min(starts), max(starts)))
    end = f"{last:%H:%M}" if last.date() == first.date() else f"{last:%Y-%m-%d %H:%M}"
    return f"{first:%Y-%m-%d %H:%M} – {end} UTC" if len(starts) > 1 else f"{first:%Y-%m-%d %H:%M} UTC"


# -- every figure as a file of its own, for papers and slides --------------------------------------

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
        # Several drawings of one name are numbered.
        plain = "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name)
        count = sum(other == plain or other.rpartition("-")[0] == plain for other in drawn)
        drawn[plain if plain not in drawn else f"{plain}-{count + 1}"] = kept(figure)

    with kept_by(keep):
        report_sections(read_run(folder))
    return drawn


def _file(figure: Figure, kind: str) -> bytes:
    stream = io.BytesIO()
    with rc_context(FONTS):
        figure.savefig(stream, format=kind, facecolor="white", dpi=PNG_DPI, metadata=NO_DATE[kind])
    return stream.getvalue()
