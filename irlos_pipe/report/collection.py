"""The report on several experiments: one file that needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.product.results import Provenance
from irlos_pipe.report.chapter import Chapter
from irlos_pipe.report.content import Section, Table
from irlos_pipe.report.render import rendered
from irlos_pipe.report.text import MISSING

TEMPLATE = "collection.html.j2"


def write_collection(path: Path, title: str, note: str, chapters: Sequence[Chapter]) -> Path:
    """Write the page; the same chapters give the same file.

    Parameters
    ----------
    path : Path
        File to be written.
    title, note : str
        Title of the page, and one line below it.
    chapters : sequence of Chapter

    Raises
    ------
    IrlosError
        When it cannot be written.
    """
    page = rendered(
        TEMPLATE,
        title=title,
        note=note,
        chapters=chapters,
        contents=_contents(chapters),
        origin=_origin(chapters),
    )
    write_bytes(path, page.encode())
    return path


def _contents(chapters: Sequence[Chapter]) -> Table:
    rows = [
        (_link(one), one.status.replace("_", " "), one.sizes, _text(one.seed), one.time) for one in chapters
    ]
    marks = ["" if one.status == "ok" else "bad" for one in chapters]
    return Table(("experiment", "status", "sizes", "seed", "time"), rows, marks=marks)


def _link(chapter: Chapter) -> Markup:
    return Markup('<a href="#{}">{}</a>').format(chapter.name, chapter.title)


def _text(value: Any) -> str:
    return MISSING if value is None else str(value)


def _origin(chapters: Sequence[Chapter]) -> Section:
    """Where and with what each experiment was run."""
    run = [(one, one.made) for one in chapters if one.made]
    rows = [
        (one.name, one.finished, one.time, _text(made.jobs), f"{made.machine.host} ({made.machine.platform})")
        for one, made in run
    ]
    table = Table(("experiment", "finished", "time", "processes", "machine"), rows)
    software = dict.fromkeys(_software(made) for _, made in run)
    return Section("origin", "Machine and software", "; ".join(software), [table] if run else [])


def _software(made: Provenance) -> str:
    return ", ".join(f"{name} {version}" for name, version in made.software.items())
