"""The command of the focus loop: parses its options, runs the loop and ends with its exit code."""

from __future__ import annotations

import math
import os
import signal
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from irlos_pipe.commands import options
from irlos_pipe.commands.exits import SEE_EXIT_CODES, SIGNALS
from irlos_pipe.commands.options import FROM_0, FROM_1, argument, command, option
from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.conventions.errors import ConfigurationError, ExitCode

if TYPE_CHECKING:
    from irlos_pipe.focus.calibration import Calibration, CalibrationRequest
    from irlos_pipe.focus.journal import Journal
    from irlos_pipe.focus.service import LoopSettings
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


number = partial(option, callback=_finite)
positive = partial(number, type=click.FloatRange(min=0, min_open=True))
FROM_0_S = click.FloatRange(min=0)


@dataclass(frozen=True)
class FocusOptions:
    """Options of `irlos focus`, and what the service needs of them.

    Raises `click.UsageError` unless there is one source of frames.
    """

    output: Path = option("--output DIR", "Folder for the record and the command.")
    ring: Path | None = option("--ring FILE", "Read frames from a ring in shared memory.")
    folder: Path | None = option("--folder DIR", "Read recordings as they appear in a folder.")
    zeromq: str | None = option(
        "--zeromq ENDPOINT",
        f"Read frames from a ZeroMQ publisher, tcp://127.0.0.1:PORT say; any other machine needs {TOKEN}.",
    )
    replay: Path | None = option("--replay RUN", "Measure the ingested frames of a run once more.")
    input_name: str = option("--input", "Input of the run to replay.", default="ramp")
    speed: float = number(
        "--speed",
        "Of a replay, times the recorded rate. 0 is as fast as possible.",
        type=FROM_0_S,
        default=0.0,
        show_default=False,
    )
    acquisition: Path | None = option(
        "--acquisition FILE", "Side-car that says how the frames are taken (default: like the ramp of RUN)."
    )
    reads: int = option("--reads", "Reads added up to an exposure.", type=FROM_1, default=1)
    counter_step: int = option(
        "--counter-step", "Counts of the recorder from read to read.", type=FROM_1, default=1
    )
    gain: float = number("--gain", "Of the controller, per exposure.", default=ControllerSettings.gain)
    leak: float = number("--leak", "Of the controller, per exposure.", default=ControllerSettings.leak)
    delay: int = option(
        "--delay",
        "Exposures from the end of one to its effect.",
        type=FROM_0,
        default=ControllerSettings.delay,
    )
    limit_nm: float = positive("--limit-nm", "Largest offset.", default=ControllerSettings.limit_nm)
    jump_nm: float = positive(
        "--jump-nm",
        "Largest change at once while the loop is being closed.",
        default=ControllerSettings.jump_nm,
    )
    max_misfit: float = positive(
        "--max-misfit", "Part of the light that the model may leave unexplained, beyond noise.", default=0.3
    )
    stale_after: float | None = positive(
        "--stale-after DAYS", "Age from which a calibration is not used (default: never)."
    )
    stale_frames: float | None = positive(
        "--stale-frames SECONDS",
        f"Age from which frames command nothing (default: {FOLDER_STALE_S:g} with --folder, else never).",
    )
    despite_qc: bool = option("--despite-qc", "Take a calibration whose QC has failed, too.")
    wait: float = number(
        "--wait SECONDS", "For a ring that is not there yet.", type=FROM_0_S, default=RING_WAIT_S
    )
    silent_after: float | None = positive(
        "--silent-after SECONDS",
        f"Say after so long that no frames come (default: {SILENT_AFTER_S:g}, "
        f"with --folder {FOLDER_SILENT_AFTER_S:g}).",
    )
    shadow: bool = option("--shadow", "Only watch: measure and record, command nothing.")
    socket: Path | None = option("--socket PATH", "Publish every line of the record on a Unix socket.")
    page_port: int | None = option(
        "--page-port PORT",
        "Serve the live page on this port of this machine; 0 takes a free one.",
        type=click.IntRange(0, 65535),
    )
    page_address: str = option(
        "--page-address IP",
        f"Address of the page; any other one needs a token in {TOKEN}.",
        default="127.0.0.1",
    )
    quiet: bool = options.QUIET

    def __post_init__(self) -> None:
        if sum(one is not None for one in (self.ring, self.folder, self.zeromq, self.replay)) != 1:
            raise click.UsageError("give one of --ring, --folder, --zeromq and --replay")

    def say(self, text: str) -> None:
        if not self.quiet:
            click.echo(text)

    @property
    def silent_after_s(self) -> float:
        """A replay comes as fast as it is measured, and recordings minutes apart."""
        if self.replay is not None:
            return math.inf
        return self.silent_after or (SILENT_AFTER_S if self.folder is None else FOLDER_SILENT_AFTER_S)

    @property
    def settings(self) -> LoopSettings:
        """What the loop does with a measurement.

        Raises `ConfigurationError` if the controller cannot work with them.
        """
        from irlos_pipe.focus.service import LoopSettings

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
        from irlos_pipe.estimate.focus import Limits
        from irlos_pipe.focus.calibration import CalibrationRequest
        from irlos_pipe.focus.ring import window_of

        window = None if self.ring is None else window_of(self.ring)
        limits = Limits(misfit=self.max_misfit)
        return CalibrationRequest(run, self.acquisition, window, limits, self.despite_qc)

    def source(self, calibration: Calibration, journal: Journal) -> Source:
        """Where frames come from, given the `calibration` and the `journal` of what was recorded before."""
        from irlos_pipe.focus.recordings import Replay, WatchedFolder
        from irlos_pipe.focus.ring import RingSource
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


@command(FocusOptions, epilog=SEE_EXIT_CODES)
def focus(run: Path = argument("RUN"), **given: Any) -> None:
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
    from irlos_pipe.focus.live import PageSettings
    from irlos_pipe.focus.service import Service, Stopped
    from irlos_pipe.pipeline.resources import limited_threads

    asked = FocusOptions(**given)
    settings = asked.settings
    with limited_threads(1):
        try:
            if asked.ring is not None:
                # The recorder has still to make the ring; opening it says what is wrong with it.
                if not asked.ring.exists():
                    asked.say(f"waiting {asked.wait:g} s for the ring {asked.ring}")
                until = time.monotonic() + asked.wait
                while not asked.ring.exists() and time.monotonic() < until:
                    time.sleep(min(LOOK_S, asked.wait))
            token = os.environ.get(TOKEN, "")
            records = Service(
                asked.output,
                asked.request(run),
                settings,
                asked.source,
                silent_after_s=asked.silent_after_s,
                every_exposure_counts=asked.replay is not None,
                page=None
                if asked.page_port is None
                else PageSettings(asked.page_port, asked.page_address, token),
                socket=asked.socket,
            ).run(asked.say)
        except Stopped as stop:
            asked.say(f"{stop.records} records in {asked.output}")
            sys.exit(_code())
        except KeyboardInterrupt:
            asked.say("stopped before it began")
            sys.exit(_code())
    asked.say(f"{records} records in {asked.output}")


def _code() -> ExitCode:
    """Ended by a service manager the loop has done its work; Ctrl-C interrupts it."""
    came = click.get_current_context().meta[SIGNALS]
    return ExitCode.DONE if came and signal.SIGINT not in came else ExitCode.INTERRUPTED
