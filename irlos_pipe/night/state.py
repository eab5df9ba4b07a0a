"""What a run of `irlos night` found and did, night by night; filled in during the run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from irlos_pipe.conventions.errors import ExitCode
from irlos_pipe.night.acknowledged import acknowledge, as_line
from irlos_pipe.night.description import Description
from irlos_pipe.night.discover import Unusable
from irlos_pipe.night.grouping import LeftOut
from irlos_pipe.night.reduce import UNCHANGED, Reduced
from irlos_pipe.night.tasks import Job

DOUBTS = {"qc_failed": "a QC limit failed", "partial": "some exposures failed"}


@dataclass
class Night:
    """One night.

    Attributes
    ----------
    date : str
        Date of its evening, ISO.
    reduced : dict of str to Reduced
        Outcomes of the jobs, by the name of their task.
    alarms : list of str
        Numbers of this night that left their band, one line each.
    nothing : str
        Why there is nothing to do; empty if there is something.
    stopped : str
        What stopped the whole run before the night was finished, if anything did.
    acknowledged : frozenset of str
        Problems that somebody has seen already: they are `known` and count no more.
    """

    date: str
    recordings: list[Description] = field(default_factory=list)
    jobs: list[Job] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    unusable: list[Unusable] = field(default_factory=list)
    reduced: dict[str, Reduced] = field(default_factory=dict)
    alarms: list[str] = field(default_factory=list)
    nothing: str = ""
    stopped: str = ""
    acknowledged: frozenset[str] = frozenset()

    @property
    def unfinished(self) -> list[Job]:
        """Jobs without an outcome so far."""
        return [job for job in self.jobs if job.task.name not in self.reduced]

    @property
    def guessed(self) -> list[str]:
        """Recordings that state no time, and what their night was taken from, one line each."""
        return [
            f"{one.path}: states no time; taken for one of {self.date} by {one.night_by}"
            for one in self.recordings
            if one.night_by
        ]

    @property
    def changed(self) -> bool:
        """Whether anything was done or is wrong, so that the page has to be written again."""
        worked = any(one.action != UNCHANGED for one in self.reduced.values())
        return worked or bool(self._failures or self.alarms or self.stopped or self.unfinished)

    @property
    def failures(self) -> list[str]:
        """What could not be reduced and is not known, one line each."""
        return [line for line in self._failures if as_line(line) not in self.acknowledged]

    @property
    def known(self) -> list[str]:
        """Failures and doubts that are acknowledged."""
        found = [*self._failures, *self._doubts]
        return [line for line in found if as_line(line) in self.acknowledged]

    @property
    def _failures(self) -> list[str]:
        failed = [f"{one.name}: {one.problem}" for one in self.reduced.values() if one.problem]
        alarming = [f"{one.recording.name}: {one.reason}" for one in self.left_out if one.alarming]
        return [*(one.problem for one in self.unusable), *failed, *alarming]

    @property
    def doubts(self) -> list[str]:
        """What was reduced but should be looked at and is not known, one line each."""
        return [line for line in self._doubts if as_line(line) not in self.acknowledged]

    @property
    def _doubts(self) -> list[str]:
        doubtful = [one for one in self.reduced.values() if one.status in DOUBTS]
        return [
            *map(self._doubt, doubtful),
            *self.alarms,
        ]

    @staticmethod
    def _doubt(reduced: Reduced) -> str:
        return ": ".join([reduced.name, DOUBTS[reduced.status], *reduced.checks_failed])

    @property
    def exit_code(self) -> int:
        """5 when a part failed, 3 when everything did, 4 when a number left its limits or its band."""
        succeeded = any(not one.failed for one in self.reduced.values())
        if self.failures:
            return ExitCode.PARTIAL if succeeded else ExitCode.BAD_DATA
        partial = {self._doubt(one) for one in self.reduced.values() if one.status == "partial"}
        if partial.intersection(self.doubts):
            return ExitCode.PARTIAL
        return ExitCode.QUALITY if self.doubts else ExitCode.DONE


@dataclass
class RunState:
    """All nights of a run, by date."""

    nights: dict[str, Night] = field(default_factory=dict)
    acknowledged: frozenset[str] = frozenset()

    def night(self, date: str) -> Night:
        """Return the night of a date, a new one if there was none."""
        return self.nights.setdefault(date, Night(date, acknowledged=self.acknowledged))

    def acknowledge(self, tree: Path) -> None:
        """Make all problems of these nights known in a `tree`.

        Raises
        ------
        IrlosError
            When they cannot be written down.
        """
        problems = [line for night in self.nights.values() for line in (*night.failures, *night.doubts)]
        self.acknowledged = acknowledge(tree, problems)
        for night in self.nights.values():
            night.acknowledged = self.acknowledged

    @property
    def exit_code(self) -> int:
        """The exit code of a single night; of several nights, 5 as soon as one failed."""
        codes = {night.exit_code for night in self.nights.values()}
        partly = len(codes) > 1 and codes & {ExitCode.BAD_DATA, ExitCode.PARTIAL}
        return ExitCode.PARTIAL if partly else max(codes, default=ExitCode.DONE)
