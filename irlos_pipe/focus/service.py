"""The running loop: source, exposures, records and command put together until nothing more comes."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

from irlos_pipe.control.exposures import Accumulator, Exposure, Read
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.calibration import Calibration, CalibrationRequest
from irlos_pipe.focus.exchange import CalibrationWatch
from irlos_pipe.focus.journal import Journal
from irlos_pipe.focus.loop import FocusLoop, LoopSettings
from irlos_pipe.focus.mailbox import Command, Mailbox
from irlos_pipe.focus.page import LivePage, PageSettings
from irlos_pipe.focus.publisher import Publisher
from irlos_pipe.focus.record import Record
from irlos_pipe.focus.source import Fault, Source
from irlos_pipe.product.runfolder import owned_folder, require_free

LOG = logging.getLogger(__name__)
COMMAND = "command"
POLL_S = 0.25  # between looks at everything that is no frame
CLOCK_STEP_S = 0.5
OWN = ("focus.jsonl", COMMAND)


@dataclass(frozen=True)
class Service:
    """What `irlos focus` was asked for.

    Attributes
    ----------
    output : Path
        Folder for the record and the command.
    calibration : CalibrationRequest
    settings : LoopSettings
    open_source : callable
        Makes the source, with the calibration, and with whether an earlier loop has left a record.
    flush_after_s : float
        Silence after which an incomplete exposure is closed.
    every_exposure_counts : bool
        Whether exposures that have been overtaken are used: in a replay, not on the telescope.
    page : PageSettings or None
    socket : Path or None
    """

    output: Path
    calibration: CalibrationRequest
    settings: LoopSettings
    open_source: Callable[[Calibration, bool], Source]
    flush_after_s: float = 2.0
    every_exposure_counts: bool = False
    page: PageSettings | None = None
    socket: Path | None = None

    def run(self, report: Callable[[str], None], stopped: Callable[[], bool] = lambda: False) -> int:
        """Run until the source ends or `stopped` says so; return the number of records made.

        Parameters
        ----------
        report : callable
            Gets lines for people.
        stopped : callable

        Raises
        ------
        IrlosError
            When the loop cannot start.
        """
        with ExitStack() as stack:
            require_free(self.output, OWN)
            stack.enter_context(owned_folder(self.output))
            calibration = self.calibration.load()
            journal = stack.enter_context(closing(Journal(self.output)))
            source = stack.enter_context(closing(self.open_source(calibration, journal.last is not None)))
            _require_window(source, calibration)
            mailbox = stack.enter_context(closing(Mailbox(self.output / COMMAND)))
            page = None if self.page is None else stack.enter_context(closing(LivePage(self.page)))
            publisher = None if self.socket is None else stack.enter_context(closing(Publisher(self.socket)))
            running = _Running(self, calibration, journal, mailbox, page, publisher, report)
            running.begin()
            try:
                while not stopped() and (arrivals := source.poll(POLL_S)) is not None:
                    running.take(arrivals)
            finally:  # interrupted, too
                running.finish()
            return running.records


@dataclass
class _Running:
    """The loop with all that it writes to."""

    service: Service
    calibration: Calibration
    journal: Journal
    mailbox: Mailbox
    page: LivePage | None
    publisher: Publisher | None
    report: Callable[[str], None]
    records: int = 0
    damaged: int = 0
    _clock_s: float = field(default_factory=lambda: time.time() - time.monotonic())

    def __post_init__(self) -> None:
        settings, last = self.service.settings, self.journal.last
        self.loop = FocusLoop(self.calibration, settings, last)
        done = (None, math.nan) if last is None else (last.exposure, last.unix_s)
        self.accumulator = Accumulator(settings.reads, settings.counter_step, *done)
        self.watch = CalibrationWatch(self.service.calibration, self.calibration)
        self.heard_s, self.full = time.monotonic(), False

    def begin(self) -> None:
        """Say that the loop runs, and from where it goes on."""
        last = self.journal.last
        text = "started" if last is None else f"started again after record {last.sequence}"
        self.note(f"{text}, calibration {self.calibration.name}")
        if self.page is not None:
            self.report(f"page: {self.page.url}")

    def take(self, arrivals: Sequence[Read | Fault]) -> None:
        """Work on what has arrived."""
        arrived_s = time.monotonic()
        exposures: list[Exposure] = []
        for one in arrivals:
            if isinstance(one, Fault):
                self.damaged += 1
                self.note(one.text)
            else:
                exposures += self.accumulator.add(one)
        if arrivals:
            self.heard_s = arrived_s
        elif arrived_s - self.heard_s > self.service.flush_after_s:
            exposures += self.accumulator.flush()
        for position, exposure in enumerate(exposures, 1):
            overtaken = position < len(exposures) and not self.service.every_exposure_counts
            self.publish(exposure, arrived_s, overtaken)
        self.look_around()

    def publish(self, exposure: Exposure, arrived_s: float, overtaken: bool) -> None:
        """Command first, as light does not wait; then the record."""
        if exposure.restarted:
            self.note(f"the counter of the recorder went back to {exposure.first_counter}")
        record = self.loop.record(exposure, arrived_s, damaged=self.damaged, overtaken=overtaken)
        self.damaged = 0
        if not self.service.settings.shadow:
            self.mailbox.write(Command(record.sequence, record.offset_nm, record.counter))
        self.journal.last = record
        self.records += 1
        self.show(record, self.journal.add(record))

    def show(self, record: Record, line: str) -> None:
        """Pass the record on to whoever looks."""
        if self.page is not None:
            self.page.show(record.sequence, line)
        if self.publisher is not None:
            self.publisher.send(line)

    def look_around(self) -> None:
        """Disk, clock and calibration."""
        self.journal.flush()
        if (self.journal.waiting > 0) != self.full:
            self.full = self.journal.waiting > 0
            problem = self.journal.problem
            self.report(f"records wait in memory: {problem}" if self.full else "all records are written")
        clock_s = time.time() - time.monotonic()
        if abs(clock_s - self._clock_s) > CLOCK_STEP_S:
            self.note(f"the clock was set by {clock_s - self._clock_s:+.1f} s")
        self._clock_s = clock_s
        news = self.watch.news()
        if news is not None and news.calibration is not None:
            self.loop.calibration = news.calibration
            self.note(f"calibration {news.calibration.name}")
        elif news is not None:
            self.note(f"calibration kept: {news.problem}")

    def finish(self) -> None:
        """Close what is open; an exposure that was cut short does not count."""
        for exposure in self.accumulator.flush():
            self.publish(exposure, time.monotonic(), False)
        self.note("stopped")

    def note(self, text: str) -> None:
        """Record and report something that happened."""
        self.journal.event(text)
        self.report(text)


def _require_window(source: Source, calibration: Calibration) -> None:
    """Frames whose size is known from the start must be those of the calibration.

    Raises
    ------
    InputDataError
        If they are not.
    """
    window = getattr(source, "window", calibration.window)
    if window != calibration.window:
        raise InputDataError(
            f"frames of {window[0]}x{window[1]} px, and the calibration {calibration.name} is for "
            f"{calibration.window[0]}x{calibration.window[1]} px; give one for these frames"
        )
