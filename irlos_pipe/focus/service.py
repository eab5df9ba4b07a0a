"""The running loop: source, exposures, records and command put together until nothing more comes."""

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

from irlos_pipe.control.controller import ControllerSettings, ControllerState, Decision, Response, decide
from irlos_pipe.control.exposures import Accumulator, Exposure, Read
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.focus import Measurement
from irlos_pipe.focus.calibration import (
    MISFIT,
    Calibration,
    CalibrationRequest,
    CalibrationWatch,
    exposure_differences,
    optical_differences,
)
from irlos_pipe.focus.journal import (
    FAILED,
    FROZEN,
    INCOMPLETE,
    LATE,
    OLD,
    SHADOW,
    STALE,
    WINDOW,
    Journal,
    Record,
)
from irlos_pipe.focus.live import HOUR_S, LivePage, PageSettings, Publisher
from irlos_pipe.focus.mailbox import Command, Mailbox
from irlos_pipe.focus.source import Arrival, Clock, Fault, Source
from irlos_pipe.product.runfolder import owned_folder, require_free

OPEN = "open"  # why an offset is held: nothing answers it
NUMBERS = ("defocus_nm", "tip_nm", "tilt_nm", "flux_e", "background_e", "chi2_nu", "misfit")

COMMAND = "command"
POLL_S = 0.25  # longest wait for frames between looks at everything else
CLOCK_STEP_S = 0.5  # step of the system's clock against the steady one that is reported
AHEAD_S = 5.0  # ahead of both clocks of the loop, from which a read's time is in the future
OWN = ("focus.jsonl", COMMAND)
FAULTS_A_MINUTE, MINUTE_S = 20, 60.0  # faults that are reported each in a minute; further ones are counted


@dataclass(frozen=True)
class LoopSettings:
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    reads: int = 1  # added up to an exposure
    counter_step: int = 1  # of the recorder's counter, from one read to the next
    shadow: bool = False  # measure and record, command nothing
    stale_after_s: float = math.inf  # age of the calibration from which nothing is valid
    stale_frames_s: float = math.inf  # age of an exposure from which it is not used
    least_reads: float = 0.5  # part of an exposure's reads below which it is not used


class FocusLoop:
    """Makes a record of every exposure; goes on from the last record of an earlier start.

    `problem` says what was unforeseen in the last measurement, if anything was; `open` says how the focus
    answers the offsets, where the loop is not closed: from then on the offset is held.
    """

    def __init__(self, calibration: Calibration, settings: LoopSettings, last: Record | None = None):
        self.calibration, self._settings = calibration, settings
        self._state = ControllerState() if last is None else last.state
        self.sequence = 0 if last is None else last.sequence
        self.problem = self.open = ""
        self._response = Response(settings.controller.delay)
        self._last_index: int | None = None
        self._clock = Clock()

    def take_over(self, number: int, offset_nm: float) -> None:
        """Go on from a command, of a `number`, of which there is no record."""
        self.sequence, self._state = number, ControllerState(offset_nm)

    def record(
        self, exposure: Exposure, arrived_s: float, *, damaged: int = 0, overtaken: bool = False
    ) -> Record:
        """Measure an `exposure` and decide on the offset.

        Its last read arrived at `arrived_s` of the monotonic clock; so many reads before were `damaged`. One
        that a later exposure has `overtaken` is recorded and not used.
        """
        measured = self._judged(exposure, self._measured(exposure), overtaken)
        decision = self._decided(exposure, measured)
        self.sequence += 1
        state = decision.state
        return Record(
            sequence=self.sequence,
            exposure=exposure.index,
            counter=exposure.first_counter,
            unix_s=exposure.unix_s,
            reads=exposure.reads,
            reads_late=exposure.late,
            reads_doubled=exposure.doubled,
            reads_missing=exposure.missing,
            reads_damaged=damaged,
            **{name: getattr(measured, name) for name in NUMBERS},
            sigma_nm=self._sigma_nm(measured),
            sigma_photon_nm=measured.sigma_nm,
            valid=measured.valid,
            reasons=measured.reasons,
            mode=SHADOW if self._settings.shadow else state.mode,
            offset_nm=state.offset_nm,
            commanded=decision.commanded,
            held=decision.held,
            clipped=decision.clipped,
            settling=state.settling,
            outside=state.outside,
            latency_ms=(time.monotonic() - arrived_s) * 1e3,
            calibration=self.calibration.name,
            recording=exposure.recording,
            recorded_unix_s=time.time(),
        )

    def _measured(self, exposure: Exposure) -> Measurement:
        if exposure.image_e.shape != self.calibration.window:
            return Measurement(math.nan, math.nan, False, (WINDOW,))
        self.problem = ""
        try:
            return self.calibration.sensor.measurement(exposure.image_e, exposure.reads)
        except Exception as error:  # whatever stands in an image, the loop goes on
            logging.getLogger(__name__).debug("measurement", exc_info=True)
            self.problem = f"{type(error).__name__}: {error}"
            return Measurement(math.nan, math.nan, False, (FAILED,))

    def _sigma_nm(self, measured: Measurement) -> float:
        errors = self.calibration.errors
        if errors is None:
            return math.nan
        beside = measured.beside
        growth = (1.0, 0.0) if beside is None else self.calibration.ordinary.growth(beside)
        return errors.sigma_nm(measured.defocus_nm, measured.sigma_nm, *growth)

    def _judged(self, exposure: Exposure, measured: Measurement, overtaken: bool) -> Measurement:
        """With the reasons that the image does not show."""
        calibration, settings, beside = self.calibration, self._settings, measured.beside
        age_s = abs(exposure.unix_s - calibration.made_unix_s)  # NaN is never too old
        against = {
            MISFIT: beside is not None
            and not calibration.ordinary.fits(beside, calibration.sensor.limits.misfit),
            FROZEN: exposure.repeated > 0,
            OLD: not settings.shadow and self._clock.off_s(exposure.unix_s) > settings.stale_frames_s,
            LATE: overtaken,
            STALE: age_s > settings.stale_after_s,
            INCOMPLETE: exposure.reads < settings.least_reads * exposure.expected,
        }
        reasons = (*measured.reasons, *(reason for reason, holds in against.items() if holds))
        return measured._replace(valid=not reasons, reasons=reasons)

    def _decided(self, exposure: Exposure, measured: Measurement) -> Decision:
        if self._settings.shadow:
            return Decision(self._state, False)
        defocus_nm = measured.defocus_nm if measured.valid else None
        passed = 1 if self._last_index is None else max(1, exposure.index - self._last_index)
        self._last_index = exposure.index
        self.open = self.open or self._response.verdict(defocus_nm, self._state.offset_nm, passed)
        if self.open:
            return Decision(self._state, False, held=OPEN if measured.valid else "")
        decision = decide(self._state, defocus_nm, self._settings.controller)
        self._state = decision.state
        return decision


Tell = Callable[[str], None]  # gets lines for people


class Stopped(KeyboardInterrupt):
    """The loop was interrupted after it had made so many `records`."""

    def __init__(self, records: int):
        super().__init__()
        self.records = records


@dataclass(frozen=True)
class Service:
    """What `irlos focus` was asked for."""

    output: Path  # folder for the record and the command
    calibration: CalibrationRequest
    settings: LoopSettings
    open_source: Callable[[Calibration, Journal], Source]  # the record knows what has been measured
    flush_after_s: float = 2.0  # silence after which an incomplete exposure is closed
    silent_after_s: float = math.inf  # silence after which an event says that no frames come
    every_exposure_counts: bool = False  # overtaken ones command, too: in a replay, not on the telescope
    page: PageSettings | None = None
    socket: Path | None = None

    def run(self, report: Tell, stopped: Callable[[], bool] = lambda: False) -> int:
        """Run until the source ends or `stopped` says so; `report` gets lines; return the number of records.

        Raises `IrlosError` when the loop cannot start; `Stopped` when it is interrupted.
        """
        with ExitStack() as stack:
            require_free(self.output, OWN)
            stack.enter_context(owned_folder(self.output))
            calibration = self.calibration.load()
            journal = stack.enter_context(closing(Journal(self.output)))
            source = stack.enter_context(closing(self.open_source(calibration, journal)))
            _require_agreement(source, calibration)
            mailbox = stack.enter_context(closing(Mailbox(self.output / COMMAND)))
            goes_on, why = _left_off(journal, mailbox, self.settings, self.output)
            page = None if self.page is None else stack.enter_context(closing(LivePage(self.page)))
            publisher = None if self.socket is None else stack.enter_context(closing(Publisher(self.socket)))
            running = _Running(self, calibration, journal, mailbox, goes_on, page, publisher, report)
            running.begin(source, why)
            try:
                running.follow(source, stopped)
            except KeyboardInterrupt:
                raise Stopped(running.records) from None
            return running.records


def _require_agreement(source: Source, calibration: Calibration) -> None:
    """Frames must be those of the calibration, as far as the source knows from the start.

    Raises `InputDataError` if their window, instrument or light path is another.
    """
    window = getattr(source, "window", calibration.window)
    if window != calibration.window:
        raise InputDataError(
            f"frames of {window[0]}x{window[1]} px, and the calibration {calibration.name} is for "
            f"{calibration.window[0]}x{calibration.window[1]} px; give one for these frames"
        )
    name = getattr(source, "instrument_name", calibration.instrument_name)
    acquisition = getattr(source, "acquisition", calibration.acquisition)
    against = optical_differences(acquisition, calibration.acquisition)
    if name != calibration.instrument_name:
        against.insert(0, f"instrument {name}, not {calibration.instrument_name}")
    if against:
        raise InputDataError(
            f"the frames are not those that the calibration {calibration.name} is for: {'; '.join(against)}; "
            "give one for these frames"
        )


def _left_off(
    journal: Journal, mailbox: Mailbox, settings: LoopSettings, output: Path
) -> tuple[Command | None, str]:
    """The command that an earlier loop has left, where its last record says otherwise; and what to say of it.

    The command is written first, is checked by itself, and is what the telescope has done.

    Raises `InputDataError` if the offset that stands cannot be known, or is not within the limit.
    """
    last, command = journal.last, mailbox.read()
    number, offset_nm = (0, 0.0) if last is None else (last.sequence, last.offset_nm)
    why = [f"{journal.damaged} damaged lines at the end of the record"] if journal.damaged else []
    if settings.shadow:
        return None, "; ".join(why)
    if command is None and (journal.damaged or (mailbox.damaged and last is None)):
        raise InputDataError(
            f"{output}: the offset that stands is not known: the end of the record and the command are "
            "damaged or lost; bring the telescope to a known focus and choose another output"
        )
    if command is not None and (command.number > number or command.offset_nm != offset_nm):
        number, offset_nm = max(number, command.number), command.offset_nm
        command = Command(number, offset_nm, command.counter)
        record = "no record" if last is None else f"the last sound record is number {last.sequence}"
        why += [record, f"goes on from command {number}, {offset_nm:.1f} nm"]
    else:
        command = None
        why += ["the command is damaged"] if mailbox.damaged else []
    if abs(offset_nm) > settings.controller.limit_nm:
        raise InputDataError(
            f"{output}: the offset that stands, {offset_nm:.1f} nm, is beyond --limit-nm "
            f"{settings.controller.limit_nm:g}; raise that, or choose another output"
        )
    return command, "; ".join(why)


@dataclass
class _Running:
    """The loop with all that it writes to; it goes on from a command where that is ahead of the record."""

    service: Service
    calibration: Calibration
    journal: Journal
    mailbox: Mailbox
    goes_on: Command | None
    page: LivePage | None
    publisher: Publisher | None
    report: Tell
    records: int = 0
    damaged: int = 0
    clock: Clock = field(default_factory=Clock)
    _clock_s: float = field(default_factory=lambda: time.time() - time.monotonic())

    def __post_init__(self) -> None:
        settings, last, command = self.service.settings, self.journal.last, self.goes_on
        self.loop = FocusLoop(self.calibration, settings, last)
        if command is not None:
            self.loop.take_over(command.number, command.offset_nm)
        done = () if last is None else (last.exposure, last.unix_s, last.recording)
        if last is not None and self.clock.ahead_s(last.unix_s) > AHEAD_S:  # of a clock that was wrong
            done = (last.exposure, math.nan, last.recording)
        if command is not None and (last is None or not last.recording):
            done = (command.counter // (settings.reads * settings.counter_step), *done[1:])
        self.accumulator = Accumulator(settings.reads, settings.counter_step, *done)
        self.watch = CalibrationWatch(self.service.calibration, self.calibration)
        self.heard_s, self.silent, self.full = time.monotonic(), False, False
        self.faults = _SparingNotes(self.note)

    def begin(self, source: Source, why: str) -> None:
        """Say that the loop runs, from where it goes on and why, and with which calibration."""
        if self.page is not None:
            for written_s, line in self.journal.recent(time.time() - HOUR_S):
                self.page.show(line, written_s)
        number = self.loop.sequence
        text = f"started again after record {number}" if number else "started"
        self.note(f"{text}, calibration {self.calibration.name}")
        if why:
            self.note(why)
        self.note_calibration(self.calibration)
        acquisition = getattr(source, "acquisition", self.calibration.acquisition)
        if against := exposure_differences(acquisition, self.calibration.acquisition):
            self.note(f"frames exposed otherwise than the calibration says: {'; '.join(against)}")
        if self.page is not None:
            self.report(f"page: {self.page.url}")

    def follow(self, source: Source, stopped: Callable[[], bool]) -> None:
        try:
            while not stopped() and (arrivals := source.poll(POLL_S)) is not None:
                self.take(arrivals)
        finally:  # interrupted, too
            self.finish()

    def note_calibration(self, calibration: Calibration) -> None:
        if calibration.notice:
            self.note(f"calibration {calibration.name}: {calibration.notice}")

    def take(self, arrivals: Sequence[Arrival]) -> None:
        arrived_s, taken = time.monotonic(), self.accumulator.taken
        exposures = [exposure for one in arrivals for exposure in self.arrived(one)]
        self.listen(self.accumulator.taken > taken, arrived_s)
        if arrived_s - self.heard_s > self.service.flush_after_s:
            exposures += self.accumulator.flush()
        all_count = self.service.every_exposure_counts or self.service.settings.shadow
        for position, exposure in enumerate(exposures, 1):
            self.publish(exposure, arrived_s, position < len(exposures) and not all_count)
        self.look_around()

    def arrived(self, one: Arrival) -> list[Exposure]:
        """Take what has arrived; return the exposures that are complete with it."""
        if isinstance(one, Read):
            ahead_s = self.clock.ahead_s(one.unix_s)
            if not ahead_s > AHEAD_S:
                return self.accumulator.add(one)
            one = Fault(
                f"read {one.counter} is dated {ahead_s:.0f} s ahead of the clock of the loop; not used"
            )
        if isinstance(one, Fault):
            self.damaged += one.reads
            self.faults.add(one.text)
            return []
        self.note(one.text)
        return self.accumulator.count_anew() if one.counts_anew else []

    def listen(self, heard: bool, now_s: float) -> None:
        """Note when frames stop, and when they come again."""
        silence_s, limit_s = now_s - self.heard_s, self.service.silent_after_s
        if heard:
            if self.silent:
                self.note(f"frames come again after {silence_s:.1f} s")
            self.heard_s, self.silent = now_s, False
        elif silence_s > limit_s and not self.silent:
            self.silent = True
            self.note(f"no frames for {limit_s:g} s{self.unused()}")

    def unused(self) -> str:
        """Reads that no record accounts for."""
        count = self.accumulator.unused
        return f"; {count} reads since the last record came too late or twice" if count else ""

    def publish(self, exposure: Exposure, arrived_s: float, overtaken: bool) -> None:
        """Command first, as light does not wait; then the record."""
        if exposure.restarted:
            last = self.journal.last
            way = "back" if last is None or exposure.first_counter < last.counter else "on"
            self.note(f"the counter of the recorder went {way} to {exposure.first_counter}")
        closed, clipped = not self.loop.open, self.journal.last is not None and self.journal.last.clipped
        record = self.loop.record(exposure, arrived_s, damaged=self.damaged, overtaken=overtaken)
        self.damaged = 0
        if not self.service.settings.shadow:
            self.mailbox.write(Command(record.sequence, record.offset_nm, record.counter))
        self.journal.last = record
        self.records += 1
        self.show(self.journal.add(record))
        if self.loop.problem:
            self.faults.add(f"exposure {record.exposure} could not be measured: {self.loop.problem}")
        if exposure.repeated:
            self.faults.add(
                f"exposure {record.exposure} repeats pixels of earlier reads: the detector is frozen"
            )
        if record.clipped and not clipped:
            self.note(f"the offset has reached its limit, {record.offset_nm:.0f} nm")
        if closed and self.loop.open:
            self.note(f"the loop is not closed: offsets are {self.loop.open}; held until it is started again")

    def show(self, line: str) -> None:
        """Pass the line of a record or an event on to whoever looks."""
        if self.page is not None:
            self.page.show(line)
        if self.publisher is not None:
            self.publisher.send(line)

    def look_around(self) -> None:
        self.journal.flush()
        self.faults.look()
        if told := self.journal.news():
            self.note(told)
        if (self.journal.waiting > 0) != self.full:
            self.full = self.journal.waiting > 0
            problem = self.journal.problem
            self.report(f"records wait in memory: {problem}" if self.full else "all records are written")
        clock_s = time.time() - time.monotonic()
        if abs(clock_s - self._clock_s) > CLOCK_STEP_S:
            self.note(f"the clock was set by {clock_s - self._clock_s:+.1f} s")
        self._clock_s = clock_s
        news = self.watch.news()
        if isinstance(news, Calibration):
            self.loop.calibration = news
            self.note(f"calibration {news.name}")
            self.note_calibration(news)
        elif news is not None:
            self.note(f"calibration kept: {news}")

    def finish(self) -> None:
        """Close what is open; an exposure that was cut short does not count."""
        for exposure in self.accumulator.flush():
            self.publish(exposure, time.monotonic(), False)
        self.faults.finish()
        self.note(f"stopped{self.unused()}")

    def note(self, text: str) -> None:
        self.show(self.journal.event(text))
        self.report(text)


@dataclass
class _SparingNotes:
    """Passes faults on, each one up to a number per minute, then only how many there were."""

    tell: Tell
    _began_s: float = field(default_factory=time.monotonic)
    _reported: int = 0
    _unreported: int = 0
    _last: str = ""

    def add(self, text: str) -> None:
        """Tell a fault, a `text` of one line, or count it."""
        self.look()
        if self._reported < FAULTS_A_MINUTE:
            self._reported += 1
            self.tell(text)
        else:
            self._unreported, self._last = self._unreported + 1, text

    def look(self) -> None:
        """Tell at the end of a minute how many were not reported."""
        if time.monotonic() - self._began_s >= MINUTE_S:
            self.finish()
            self._began_s, self._reported = time.monotonic(), 0

    def finish(self) -> None:
        """Tell how many are not reported yet."""
        if self._unreported:
            self.tell(f"{self._unreported} more faults, the last: {self._last}")
        self._unreported = 0
