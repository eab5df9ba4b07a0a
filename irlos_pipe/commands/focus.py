"""The command of the focus loop: parses its options, runs the loop and ends with its exit code."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from irlos_pipe.commands.exits import EXIT_CODES
from irlos_pipe.commands.options import FOLDER
from irlos_pipe.conventions.errors import ConfigurationError, ExitCode

if TYPE_CHECKING:
    from irlos_pipe.focus.calibration import Calibration, CalibrationRequest
    from irlos_pipe.focus.journal import Journal
    from irlos_pipe.focus.loop import LoopSettings
    from irlos_pipe.focus.page import PageSettings
    from irlos_pipe.focus.source import Source

DAY_S = 86400.0
TOKEN = "IRLOS_FOCUS_TOKEN"
SILENT_AFTER_S, FOLDER_SILENT_AFTER_S = 10.0, 600.0
FOLDER_STALE_S = 900.0
RING_WAIT_S, LOOK_S = 60.0, 0.2


def _finite(ctx: click.Context, option: click.Parameter, value: float | None) -> float | None:
    """Refuse what is no number; click takes it for one within any range."""
    if value is not None and not math.isfinite(value):
        raise ConfigurationError(f"{option.opts[0]} {value:g}: give a finite number")
    return value


@click.command(epilog=EXIT_CODES)
@click.argument("run", metavar="RUN", type=FOLDER)
@click.option(
    "--output", type=FOLDER, required=True, metavar="DIR", help="Folder for the record and the command."
)
@click.option("--ring", type=FOLDER, metavar="FILE", help="Read frames from a ring in shared memory.")
@click.option("--folder", type=FOLDER, metavar="DIR", help="Read recordings as they appear in a folder.")
@click.option(
    "--zeromq",
    metavar="ENDPOINT",
    help=f"Read frames from a ZeroMQ publisher, tcp://127.0.0.1:PORT say; any other machine needs {TOKEN}.",
)
@click.option("--replay", type=FOLDER, metavar="RUN", help="Measure the ingested frames of a run once more.")
@click.option("--input", "input_name", default="ramp", show_default=True, help="Input of the run to replay.")
@click.option(
    "--speed",
    type=click.FloatRange(min=0),
    callback=_finite,
    default=0.0,
    help="Of a replay, times the recorded rate. 0 is as fast as possible.",
)
@click.option(
    "--acquisition",
    type=FOLDER,
    metavar="FILE",
    help="Side-car that says how the frames are taken (default: like the ramp of RUN).",
)
@click.option(
    "--reads", type=click.IntRange(min=1), default=1, show_default=True, help="Reads added up to an exposure."
)
@click.option(
    "--counter-step",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Counts of the recorder from read to read.",
)
@click.option(
    "--gain",
    type=float,
    callback=_finite,
    default=0.4,
    show_default=True,
    help="Of the controller, per exposure.",
)
@click.option(
    "--leak",
    type=float,
    callback=_finite,
    default=0.0,
    show_default=True,
    help="Of the controller, per exposure.",
)
@click.option(
    "--delay",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Exposures from the end of one to its effect.",
)
@click.option(
    "--limit-nm",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    default=1500.0,
    show_default=True,
    help="Largest offset.",
)
@click.option(
    "--jump-nm",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    default=400.0,
    show_default=True,
    help="Largest change at once while the loop is being closed.",
)
@click.option(
    "--max-misfit",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    default=0.3,
    show_default=True,
    help="Part of the light that the model may leave unexplained, beyond noise.",
)
@click.option(
    "--stale-after",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    metavar="DAYS",
    help="Age from which a calibration is not used (default: never).",
)
@click.option(
    "--stale-frames",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    metavar="SECONDS",
    help=f"Age from which frames command nothing (default: {FOLDER_STALE_S:g} with --folder, else never).",
)
@click.option("--despite-qc", is_flag=True, help="Take a calibration whose QC has failed, too.")
@click.option(
    "--wait",
    type=click.FloatRange(min=0),
    callback=_finite,
    default=RING_WAIT_S,
    show_default=True,
    metavar="SECONDS",
    help="For a ring that is not there yet.",
)
@click.option(
    "--silent-after",
    type=click.FloatRange(min=0, min_open=True),
    callback=_finite,
    metavar="SECONDS",
    help=f"Say after so long that no frames come (default: {SILENT_AFTER_S:g}, "
    f"with --folder {FOLDER_SILENT_AFTER_S:g}).",
)
@click.option("--shadow", is_flag=True, help="Only watch: measure and record, command nothing.")
@click.option(
    "--socket", type=FOLDER, metavar="PATH", help="Publish every line of the record on a Unix socket."
)
@click.option(
    "--page-port",
    type=click.IntRange(0, 65535),
    metavar="PORT",
    help="Serve the live page on this port of this machine; 0 takes a free one.",
)
@click.option(
    "--page-address",
    default="127.0.0.1",
    show_default=True,
    metavar="IP",
    help=f"Address of the page; any other one needs a token in {TOKEN}.",
)
@click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors.")
@click.pass_context
def focus(ctx: click.Context, run: Path, output: Path, **given: Any) -> None:
    """Close the slow focus loop with the calibration of the folder RUN.

    Frames come from --ring, --folder, --zeromq or --replay. Of every exposure the loop measures tip, tilt and
    defocus, says whether the measurement is valid and why not, and commands the offset of the
    focus. From a defocus of up to 900 nm it finds into its linear range by limited jumps. A
    measurement that is not valid never changes the offset. The loop runs until it is interrupted or
    the replay ends; started again with the same DIR it goes on where it was. Another calibration
    that appears in RUN, a folder or a link to one, is taken without a stop.

    Stopped by Ctrl-C it ends with exit code 130, by SIGTERM or SIGHUP, as a service manager does it, with 0.

    \b
    Examples:
      irlos focus night/calibration --ring /dev/shm/irlos --output loop --page-port 8800
      irlos focus calibration --folder /data/irlos/tonight --output loop --shadow
      irlos focus calibration --replay calibration --input ramp --output again

    \b
    DIR will hold:
      focus.jsonl    one line of JSON per exposure, and what happened between (docs/focus.md)
      focus.sqlite   the same in tables
      command        the offset, for the telescope
    """
    from irlos_pipe.focus.service import Service, Stopped
    from irlos_pipe.pipeline.resources import limited_threads

    options = FocusOptions(**given)
    settings = options.settings

    def say(text: str) -> None:
        if not options.quiet:
            click.echo(text)

    with _ended_by_signals() as signals, limited_threads(1):
        try:
            if options.ring is not None:
                _await(options.ring, options.wait, say)
            records = Service(
                output,
                options.request(run),
                settings,
                options.source,
                silent_after_s=options.silent_after_s,
                every_exposure_counts=options.replay is not None,
                page=options.page,
                socket=options.socket,
            ).run(say)
        except Stopped as stop:
            say(f"{stop.records} records in {output}")
            ctx.exit(_code_of(signals))
        except KeyboardInterrupt:
            say("stopped before it began")
            ctx.exit(_code_of(signals))
    say(f"{records} records in {output}")


@dataclass(frozen=True)
class FocusOptions:
    """Options of `irlos focus` by their names, and what the service wants of them.

    Raises
    ------
    click.UsageError
        Unless there is one source of frames.
    """

    ring: Path | None
    folder: Path | None
    zeromq: str | None
    replay: Path | None
    input_name: str
    speed: float
    acquisition: Path | None
    reads: int
    counter_step: int
    gain: float
    leak: float
    delay: int
    limit_nm: float
    jump_nm: float
    max_misfit: float
    stale_after: float | None
    stale_frames: float | None
    despite_qc: bool
    wait: float
    silent_after: float | None
    shadow: bool
    socket: Path | None
    page_port: int | None
    page_address: str
    quiet: bool

    def __post_init__(self) -> None:
        if sum(one is not None for one in (self.ring, self.folder, self.zeromq, self.replay)) != 1:
            raise click.UsageError("give one of --ring, --folder, --zeromq and --replay")

    @property
    def silent_after_s(self) -> float:
        """A replay comes as fast as it is measured, and recordings minutes apart."""
        if self.replay is not None:
            return math.inf
        return self.silent_after or (SILENT_AFTER_S if self.folder is None else FOLDER_SILENT_AFTER_S)

    @property
    def settings(self) -> LoopSettings:
        """What the loop does with a measurement.

        Raises
        ------
        ConfigurationError
            The controller cannot work with them.
        """
        from irlos_pipe.control.controller import ControllerSettings
        from irlos_pipe.focus.loop import LoopSettings

        try:
            controller = ControllerSettings(
                gain=self.gain, leak=self.leak, delay=self.delay, limit_nm=self.limit_nm, jump_nm=self.jump_nm
            )
        except ValueError as problem:
            raise ConfigurationError(str(problem)) from None
        shadow = self.shadow or self.replay is not None
        stale_after_s = math.inf if self.stale_after is None else self.stale_after * DAY_S
        frames_s = self.stale_frames or (math.inf if self.folder is None else FOLDER_STALE_S)
        return LoopSettings(controller, self.reads, self.counter_step, shadow, stale_after_s, frames_s)

    def request(self, run: Path) -> CalibrationRequest:
        """The calibration of a `run`, for the frames that will come."""
        from irlos_pipe.estimate.focus.sensor import Limits
        from irlos_pipe.focus.calibration import CalibrationRequest
        from irlos_pipe.focus.ring import window_of

        window = None if self.ring is None else window_of(self.ring)
        limits = Limits(misfit=self.max_misfit)
        return CalibrationRequest(run, self.acquisition, window, limits, self.despite_qc)

    def source(self, calibration: Calibration, journal: Journal) -> Source:
        """Where frames come from, given the `calibration` and the `journal` of what was recorded before."""
        from irlos_pipe.focus.replay import Replay
        from irlos_pipe.focus.ring import RingSource
        from irlos_pipe.focus.watched import WatchedFolder
        from irlos_pipe.focus.zeromq import ZeroMqSource

        if self.ring is not None:
            return RingSource(self.ring)
        if self.folder is not None:
            return WatchedFolder(
                self.folder, calibration.instrument, calibration.acquisition, journal.earlier
            )
        if self.zeromq is not None:
            return ZeroMqSource(self.zeromq, os.environ.get(TOKEN, ""), calibration.window)
        assert self.replay is not None, "one of the four was given"
        return Replay(self.replay, self.input_name, self.speed)

    @property
    def page(self) -> PageSettings | None:
        """Of the live page, if one is wanted."""
        from irlos_pipe.focus.page import PageSettings

        if self.page_port is None:
            return None
        return PageSettings(self.page_port, self.page_address, os.environ.get(TOKEN, ""))


@contextmanager
def _ended_by_signals() -> Iterator[list[int]]:
    """End the block on SIGTERM and SIGHUP as on Ctrl-C; yield the list of those that came."""
    came: list[int] = []

    def end(number: int, _: object) -> None:
        came.append(number)
        raise KeyboardInterrupt

    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    for number, handler in before.items():
        if handler != signal.SIG_IGN:  # as under nohup
            signal.signal(number, end)
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _code_of(signals: list[int]) -> ExitCode:
    """A service that ends when it is told to has done its work; Ctrl-C interrupts it."""
    return ExitCode.DONE if signals else ExitCode.INTERRUPTED


def _await(ring: Path, wait_s: float, say: Callable[[str], None]) -> None:
    """Wait for a ring that the recorder has still to make; opening it says what is wrong with it."""
    if not ring.exists():
        say(f"waiting {wait_s:g} s for the ring {ring}")
    until = time.monotonic() + wait_s
    while not ring.exists() and time.monotonic() < until:
        time.sleep(min(LOOK_S, wait_s))
