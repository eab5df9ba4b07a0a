"""What a run of `irlos night` found and did, night by night; filled in during the run."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from irlos_pipe.conventions.errors import ExitCode, IrlosError
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.regular import read_regular
from irlos_pipe.night.recordings import Description, LeftOut
from irlos_pipe.night.reduce import UNCHANGED, Job, Reduced

DOUBTS = {"qc_failed": "a QC limit failed", "partial": "some exposures failed"}
# Problems that somebody has seen: a text file of the tree, which may be edited, with one line each as it was
# reported. They are shown as known and not reported again; a problem that changes is a new one.
ACKNOWLEDGED = "acknowledged.txt"
HEAD = "# Problems that are known and not reported again; delete a line to be told again."


def page_path(tree: Path, date: str) -> Path:
    return tree / f"night_{date}.html"


@dataclass
class Night:
    date: str  # date of its evening, ISO
    recordings: list[Description] = field(default_factory=list)
    jobs: list[Job] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    # Outcomes of the jobs, by the name of their task.
    reduced: dict[str, Reduced] = field(default_factory=dict)
    # Numbers of this night that left their band, one line each.
    alarms: list[str] = field(default_factory=list)
    nothing: str = ""  # why there is nothing to do; empty if there is something
    stopped: str = ""  # what stopped the whole run before the night was finished, if anything did
    # Problems that somebody has seen already: they are `known` and count no more.
    acknowledged: frozenset[str] = frozenset()

    @property
    def unfinished(self) -> list[Job]:
        return [job for job in self.jobs if job.task.name not in self.reduced]

    @property
    def guessed(self) -> list[str]:
        """Recordings that state no time that can be read, and what gave their night, one line each."""
        return [
            f"{one.path}: states no time that can be read; taken for one of {self.date} by {one.night_by}"
            for one in self.recordings
            if one.night_by
        ]

    @property
    def unusable(self) -> list[LeftOut]:
        """What cannot be read as a recording."""
        return [one for one in self.left_out if one.found_as == "unusable"]

    @property
    def not_reduced(self) -> list[LeftOut]:
        """Recordings that can be read and are left out."""
        return [one for one in self.left_out if one.found_as != "unusable"]

    @property
    def changed(self) -> bool:
        """Whether anything was done or is wrong, so that the page has to be written again."""
        worked = any(one.action != UNCHANGED for one in self.reduced.values())
        return worked or bool(self._failures or self.alarms or self.stopped or self.unfinished)

    @property
    def failures(self) -> list[str]:
        """What could not be reduced and is not known, one line each."""
        return [line for line in self._failures if _as_line(line) not in self.acknowledged]

    @property
    def doubts(self) -> list[str]:
        """What was reduced but should be looked at and is not known, one line each."""
        return [line for line in self._doubts if _as_line(line) not in self.acknowledged]

    @property
    def known(self) -> list[str]:
        return [line for line in (*self._failures, *self._doubts) if _as_line(line) in self.acknowledged]

    @property
    def _failures(self) -> list[str]:
        failed = [f"{one.name}: {one.problem}" for one in self.reduced.values() if one.problem]
        alarming = [f"{one.recording.name}: {one.reason}" for one in self.not_reduced if one.alarming]
        return [*(one.reason for one in self.unusable), *failed, *alarming]

    @property
    def _doubts(self) -> list[str]:
        return [*(_doubt(one) for one in self.reduced.values() if one.status in DOUBTS), *self.alarms]

    @property
    def exit_code(self) -> int:
        """5 when a part failed, 3 when everything did, 4 when a number left its limits or its band."""
        if self.failures:
            succeeded = any(not one.failed for one in self.reduced.values())
            return ExitCode.PARTIAL if succeeded else ExitCode.BAD_DATA
        partial = {_doubt(one) for one in self.reduced.values() if one.status == "partial"}
        if partial.intersection(self.doubts):
            return ExitCode.PARTIAL
        return ExitCode.QUALITY if self.doubts else ExitCode.DONE


def _doubt(reduced: Reduced) -> str:
    return ": ".join([reduced.name, DOUBTS[reduced.status], *reduced.checks_failed])


def _as_line(problem: str) -> str:
    """A problem as it stands in the file of those that are acknowledged."""
    return printable(problem).strip()


@dataclass
class RunState:
    nights: dict[str, Night] = field(default_factory=dict)
    acknowledged: frozenset[str] = frozenset()

    def night(self, date: str) -> Night:
        return self.nights.setdefault(date, Night(date, acknowledged=self.acknowledged))

    def leave_out(self, some: Iterable[LeftOut]) -> None:
        for one in some:
            self.night(one.recording.night).left_out.append(one)

    def acknowledge(self, tree: Path) -> None:
        """Make all problems of these nights known in a `tree`.

        Raises `IrlosError` when they cannot be written down.
        """
        problems = {_as_line(line) for one in self.nights.values() for line in (*one.failures, *one.doubts)}
        known = read_acknowledged(tree) | problems
        write_if_changed(tree / ACKNOWLEDGED, "\n".join([HEAD, *sorted(known), ""]).encode())
        self.acknowledged = known
        for night in self.nights.values():
            night.acknowledged = known

    @property
    def exit_code(self) -> int:
        """The exit code of a single night; of several nights, 5 as soon as one failed."""
        codes = {night.exit_code for night in self.nights.values()}
        partly = len(codes) > 1 and codes & {ExitCode.BAD_DATA, ExitCode.PARTIAL}
        return ExitCode.PARTIAL if partly else max(codes, default=ExitCode.DONE)


def read_acknowledged(tree: Path) -> frozenset[str]:
    """Return the problems that are acknowledged in a `tree`, none without the file.

    Raises `IrlosError` when the file cannot be read.
    """
    path = tree / ACKNOWLEDGED
    if not path.is_file():
        return frozenset()
    try:
        text = read_regular(path)
    except (OSError, ValueError) as error:
        raise IrlosError(f"{path}: cannot be read: {error}; move it away") from error
    return frozenset(line for line in text.splitlines() if line.strip() and not line.startswith("#"))
