"""A small night, and ``irlos night`` on it in a process that may come to harm."""

import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from helpers import night_bench
from markupsafe import Markup

from irlos_pipe.commands import night as cli_night
from irlos_pipe.commands.main import cli
from irlos_pipe.night import trend_plots

NOT_STARTED = 99
MORNING = "2024-02-11T0{hour}:00:00"


class Patches:
    """Stands in for pytest's ``monkeypatch`` in a process that ends with its patches."""

    @staticmethod
    def setitem(mapping: dict, key: object, value: object) -> None:
        mapping[key] = value


@dataclass(frozen=True)
class End:
    """How a process ended."""

    code: int  # exit code; minus the signal that killed it
    stderr: str  # what it wrote there
    cpu_s: float  # processor time that it used [s]


def make_night(folder: Path, patches: object = Patches) -> night_bench.NightBench:
    """Write a night of a calibration, a ramp, a second calibration and a damaged file."""
    folder.mkdir(exist_ok=True)
    bench = night_bench.make(folder, patches)
    bench.record(MORNING.format(hour=3))
    bench.record(MORNING.format(hour=4), "offset", role="defocus_ramp", introduced_defocus_nm=10.0)
    bench.record(MORNING.format(hour=5), "later", numbers={"4": 20.0, "5": 3.0})
    (bench.night("2024-02-11") / "damaged.fits").write_bytes(b"SIMPLE  = nothing more")
    return bench


@dataclass(frozen=True)
class Running:
    """A process that runs ``irlos night``, and the end of a pipe with its stderr."""

    pid: int
    stderr: int

    def end(self) -> End:
        """Wait for its end."""
        with open(self.stderr) as stream:
            stderr = stream.read()
        _, status, used = os.wait4(self.pid, 0)
        return End(os.waitstatus_to_exitcode(status), stderr, used.ru_utime + used.ru_stime)


def start(bench: night_bench.NightBench, tree: Path, harm: Callable[[], None] = lambda: None) -> Running:
    """Run ``irlos night`` in a copy of this process, in which `harm` is called first."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            _run_as_child(bench, tree, harm, writing)
        finally:  # whatever happens: nothing of the parent's may be done a second time
            os._exit(NOT_STARTED)
    os.close(writing)
    return Running(pid, reading)


def run(bench: night_bench.NightBench, tree: Path, harm: Callable[[], None] = lambda: None) -> End:
    """Run ``irlos night`` to its end."""
    return start(bench, tree, harm).end()


def signalled(bench: night_bench.NightBench, tree: Path, after_s: float, number: int) -> End:
    """Run ``irlos night`` and send it a signal after a while."""
    running = start(bench, tree)
    time.sleep(after_s)
    os.kill(running.pid, number)
    return running.end()


@contextmanager
def rewritten(bench: night_bench.NightBench) -> Iterator[None]:
    """While the block lasts, a process cuts the first recording and writes it again, over and over."""
    path = min(bench.archive.rglob("cube.fits"))
    whole = path.read_bytes()
    pid = os.fork()
    if not pid:
        while True:
            with open(path, "r+b") as file:
                file.truncate(2880)
                file.write(whole)
            time.sleep(0.002)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        path.write_bytes(whole)


def end_at(cpu_s: float) -> Callable[[], None]:
    """Harm: the kernel ends the process, as by ``kill -9``, when it has used some processor time [s].

    Unlike a moment of the wall clock, this is the same part of the work on an idle and on a busy machine.
    """

    def limit() -> None:
        signal.signal(signal.SIGPROF, signal.SIG_DFL)  # nothing of the process runs after that signal
        signal.setitimer(signal.ITIMER_PROF, max(cpu_s, 1e-6))

    return limit


def no_file_above(size: int) -> Callable[[], None]:
    """Harm: files cannot grow beyond a size [bytes]; writing more fails as on a full disk."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit


def _run_as_child(bench: night_bench.NightBench, tree: Path, harm: Callable[[], None], stderr: int) -> None:
    # nothing of the parent's terminal, signals and drawing; tasks one after the other in this process
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    os.dup2(stderr, 2)
    sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115 (ends with the process)
    cli_night._runner = lambda *_: lambda work, tasks: map(work, tasks)
    for name in ("series_drawing", "structure_drawing"):
        setattr(trend_plots, name, lambda *_: Markup("<svg></svg>"))
    harm()
    recipes = [word for recipe in bench.recipes for word in ("--recipe", recipe)]
    try:
        cli(["night", str(bench.archive), "--output", str(tree), *recipes], prog_name="irlos")
    except SystemExit as end:
        sys.stderr.flush()
        os._exit(end.code or 0)
