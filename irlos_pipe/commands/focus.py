"""The command of the focus loop: parses its options, runs the loop and ends with its exit code."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from irlos_pipe.commands.exits import EXIT_CODES, terminated_like_interrupted
from irlos_pipe.commands.options import FOLDER
from irlos_pipe.conventions.errors import ConfigurationError

if TYPE_CHECKING:
    from irlos_pipe.focus.calibration import CalibrationRequest
    from irlos_pipe.focus.loop import LoopSettings
    from irlos_pipe.focus.page import PageSettings

DAY_S = 86400.0
TOKEN = "IRLOS_FOCUS_TOKEN"


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
@click.option("--gain", type=float, default=0.4, show_default=True, help="Of the controller, per exposure.")
@click.option("--leak", type=float, default=0.0, show_default=True, help="Of the controller, per exposure.")
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
    default=1500.0,
    show_default=True,
    help="Largest offset.",
)
@click.option(
    "--jump-nm",
    type=click.FloatRange(min=0, min_open=True),
    default=400.0,
    show_default=True,
    help="Largest change at once while the loop is being closed.",
)
@click.option(
    "--max-misfit",
    type=click.FloatRange(min=0, min_open=True),
    default=0.3,
    show_default=True,
    help="Part of the light that the model may leave unexplained, beyond noise.",
)
@click.option(
    "--stale-after",
    type=click.FloatRange(min=0, min_open=True),
    metavar="DAYS",
    help="Age from which a calibration is not used (default: never).",
)
@click.option("--shadow", is_flag=True, help="Only watch: measure and record, command nothing.")
@click.option("--socket", type=FOLDER, metavar="PATH", help="Publish every record on a Unix socket.")
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
def focus(
    run: Path,
    output: Path,
    ring: Path | None,
    folder: Path | None,
    zeromq: str | None,
    replay: Path | None,
    input_name: str,
    speed: float,
    acquisition: Path | None,
    reads: int,
    counter_step: int,
    gain: float,
    leak: float,
    delay: int,
    limit_nm: float,
    jump_nm: float,
    max_misfit: float,
    stale_after: float | None,
    shadow: bool,
    socket: Path | None,
    page_port: int | None,
    page_address: str,
    quiet: bool,
) -> None:
    """Close the slow focus loop with the calibration of the folder RUN.

    Frames come from --ring, --folder, --zeromq or --replay. Of every exposure the loop measures tip, tilt and
    defocus, says whether the measurement is valid and why not, and commands the offset of the
    focus. From a defocus of up to 900 nm it finds into its linear range by limited jumps. A
    measurement that is not valid never changes the offset. The loop runs until it is interrupted or
    the replay ends; started again with the same DIR it goes on where it was. Another calibration
    that appears in RUN, a folder or a link to one, is taken without a stop.

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
    from irlos_pipe.focus.service import Service
    from irlos_pipe.pipeline.resources import limited_threads

    if sum(one is not None for one in (ring, folder, zeromq, replay)) != 1:
        raise click.UsageError("give one of --ring, --folder, --zeromq and --replay")
    settings = _settings(
        gain, leak, delay, limit_nm, jump_nm, reads, counter_step, shadow or replay is not None, stale_after
    )
    service = Service(
        output,
        _request(run, acquisition, ring, max_misfit),
        settings,
        _opener(ring, folder, zeromq, replay, input_name, speed),
        every_exposure_counts=replay is not None,
        page=_page(page_port, page_address),
        socket=socket,
    )
    with terminated_like_interrupted(), limited_threads(1):
        records = service.run((lambda _: None) if quiet else click.echo)
    if not quiet:
        click.echo(f"{records} records in {output}")


def _settings(gain, leak, delay, limit_nm, jump_nm, reads, counter_step, shadow, stale_after) -> LoopSettings:
    from irlos_pipe.control.controller import ControllerSettings
    from irlos_pipe.focus.loop import LoopSettings

    try:
        controller = ControllerSettings(gain=gain, leak=leak, delay=delay, limit_nm=limit_nm, jump_nm=jump_nm)
    except ValueError as problem:
        raise ConfigurationError(str(problem)) from None
    stale_after_s = math.inf if stale_after is None else stale_after * DAY_S
    return LoopSettings(controller, reads, counter_step, shadow, stale_after_s)


def _request(run: Path, acquisition: Path | None, ring: Path | None, max_misfit: float) -> CalibrationRequest:
    from irlos_pipe.estimate.focus.sensor import Limits
    from irlos_pipe.focus.calibration import CalibrationRequest
    from irlos_pipe.focus.ring import window_of

    return CalibrationRequest(
        run, acquisition, None if ring is None else window_of(ring), Limits(misfit=max_misfit)
    )


def _opener(
    ring: Path | None,
    folder: Path | None,
    zeromq: str | None,
    replay: Path | None,
    input_name: str,
    speed: float,
):
    """What makes the source."""
    from irlos_pipe.focus.replay import Replay
    from irlos_pipe.focus.ring import RingSource
    from irlos_pipe.focus.watched import WatchedFolder
    from irlos_pipe.focus.zeromq import ZeroMqSource

    def opened(calibration, again: bool):
        if ring is not None:
            return RingSource(ring)
        if folder is not None:
            detector = calibration.acquisition.detector
            return WatchedFolder(folder, calibration.instrument, detector, from_start=again)
        if zeromq is not None:
            return ZeroMqSource(zeromq, os.environ.get(TOKEN, ""))
        assert replay is not None, "one of the four was given"
        return Replay(replay, input_name, speed)

    return opened


def _page(port: int | None, address: str) -> PageSettings | None:
    from irlos_pipe.focus.page import PageSettings

    return None if port is None else PageSettings(port, address, os.environ.get(TOKEN, ""))
