"""The page of a night, night_<date>.html: recordings, reductions, trend."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.night.page_sections import (
    left_out_section,
    numbers_of_night,
    recordings_section,
    reductions_section,
    trend_section,
    verdicts_section,
)
from irlos_pipe.night.settings import BandSettings
from irlos_pipe.night.state import Night
from irlos_pipe.night.tree import page_path
from irlos_pipe.night.trend import Trend, make_trend
from irlos_pipe.report.content import rendered
from irlos_pipe.report.text import plural

TEMPLATE = "night.html.j2"
FINISHED = '<meta name="irlos-night" content="finished">'
RUNNING = "not finished"


def begin_page(tree: Path, night: Night) -> None:
    """Write in `tree` that `night` is being reduced, for readers, and in case this process is killed.

    Raises
    ------
    IrlosError
        When it cannot be written.
    """
    _write(tree, night, None, RUNNING)


def write_page(tree: Path, night: Night, trend: Trend | None) -> None:
    """Write the page of a night that is finished, empty, or was stopped.

    Parameters
    ----------
    tree : Path
        Folder of all results.
    night : Night
        What was found and done.
    trend : Trend or None
        The trend as it was after the night; None leaves it out.

    Raises
    ------
    IrlosError
        When it cannot be written.
    """
    _write(tree, night, trend, _status(night))


def is_finished(tree: Path, date: str) -> bool:
    """Whether the page in `tree` of a `date` exists and is not that of a run that was killed or stopped."""
    path = page_path(tree, date)
    return path.is_file() and FINISHED.encode() in path.read_bytes()


def _status(night: Night) -> str:
    if night.stopped:
        return "stopped"
    if night.nothing:
        return "empty"
    return "needs a look" if night.failures or night.doubts else "ok"


def _write(tree: Path, night: Night, trend: Trend | None, status: str) -> None:
    shown = trend or make_trend((), (), BandSettings())
    sections = [
        reductions_section(night),
        verdicts_section(shown, night.date),
        trend_section(shown),
        left_out_section(night),
        recordings_section(night),
    ]
    page = rendered(
        TEMPLATE,
        date=night.date,
        status=status,
        running=status == RUNNING,
        night=night,
        finished=FINISHED if status not in (RUNNING, "stopped") else "",
        written=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        summary=_summary(night),
        key_numbers=numbers_of_night(night, shown),
        sections=list(filter(None, sections)),
    )
    write_bytes(page_path(tree, night.date), page.encode("utf-8", "backslashreplace"))


def _summary(night: Night) -> str:
    """Counts of recordings, reductions and actions."""
    actions = [one.action for one in night.reduced.values()]
    counts = {action: actions.count(action) for action in dict.fromkeys(actions)}
    done = [f"{count} {action}" for action, count in counts.items()]
    found = [plural(len(night.recordings), "recording"), plural(len(night.jobs), "reduction")]
    return ", ".join([*found, *done])
