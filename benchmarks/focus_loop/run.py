"""Runs telescope and loop as processes, harms them where a plan says so, and compares record and truth."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.focus_loop.telescope import FIRST_COUNTER, Night
from irlos_pipe.control.linear_theory import Integrator

GAIN = 0.4
SKY_FOCUS_NM = 4.5  # defocus of the simulated AO residual in an exposure of a second
LOOK_S = 0.02


@dataclass
class Trial:
    """One night in a folder."""

    folder: Path  # gets everything
    calibration: Path  # run folder
    night: Night
    # What happens when the telescope has reached an exposure; gets the trial.
    actions: dict[int, Callable[[Trial], None]] = field(default_factory=dict)
    options: list[str] = field(default_factory=list)  # further options of `irlos focus`
    speed: float = 0.0

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True)
        self.link, self.output = self.folder / "calibration", self.folder / "loop"
        self.link.symlink_to(self.calibration.resolve())
        self.ring, self.truth = self.folder / "ring", self.folder / "truth.jsonl"
        (self.folder / "night.json").write_text(json.dumps(asdict(self.night)))
        self.peak_mib: list[float] = []

    # -- processes -----------------------------------------------------------------------------

    def start_telescope(self) -> None:
        """Start the telescope, or start it again."""
        command = self.output / "command"
        self.output.mkdir(exist_ok=True)
        arguments = ["--ring", self.ring, "--command", command, "--truth", self.truth, "--speed", self.speed]
        module = [sys.executable, "-m", "benchmarks.focus_loop.process", self.folder / "night.json"]
        self.telescope = _process([*module, *arguments], self.folder / "telescope.log")

    def start_loop(self) -> None:
        """Start the loop, or start it again."""
        night = self.night
        arguments = ["--reads", night.reads, "--delay", night.delay, "--gain", GAIN, *self.options]
        program = [sys.executable, "-m", "irlos_pipe", "focus", self.link, "--ring", self.ring]
        self.loop = _process([*program, "--output", self.output, *arguments], self.folder / "loop.log")

    def run(self, report: Callable[[int], None] = lambda _: None) -> None:
        """Run the night to its end."""
        self.start_telescope()
        while not self.ring.exists():
            _require_alive(self.telescope, self.folder / "telescope.log")
            time.sleep(LOOK_S)
        self.start_loop()
        waiting = dict(sorted(self.actions.items()))
        while self.telescope.poll() is None or self._reached() < self.night.exposures:
            reached = self._reached()
            for exposure in [one for one in waiting if one <= reached]:
                waiting.pop(exposure)(self)
            self._note_memory()
            report(reached)
            _require_alive(self.loop, self.folder / "loop.log")
            if self.telescope.poll() is not None and self._reached() < self.night.exposures:
                _require_alive(self.telescope, self.folder / "telescope.log")
            time.sleep(LOOK_S)
        time.sleep(3.0)  # the last exposure may wait for reads that do not come
        self.loop.send_signal(signal.SIGTERM)
        self.loop.wait(timeout=30)

    def page_url(self) -> str:
        """Return where the page of the loop is, once it says so; empty before."""
        log = self.folder / "loop.log"
        lines = log.read_text().splitlines() if log.exists() else []
        return next((line[len("page: ") :] for line in reversed(lines) if line.startswith("page: ")), "")

    def _reached(self) -> int:
        return self.truth.read_bytes().count(b"\n") if self.truth.exists() else 0

    def _note_memory(self) -> None:
        try:
            pages = int(Path(f"/proc/{self.loop.pid}/statm").read_text().split()[1])
        except (OSError, IndexError):
            return
        self.peak_mib.append(pages * resource.getpagesize() / 2**20)

    # -- what can happen to them ---------------------------------------------------------------

    def kill_loop(self) -> None:
        """Kill the loop and start it again."""
        self.loop.kill()
        self.loop.wait()
        self.start_loop()

    def kill_telescope(self) -> None:
        """Kill the telescope and start it again."""
        self.telescope.kill()
        self.telescope.wait()
        self.start_telescope()

    def fill_disk(self) -> None:
        """Let no file of the loop grow any more."""
        size = (self.output / "focus.jsonl").stat().st_size
        resource.prlimit(self.loop.pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    def free_disk(self) -> None:
        """Let them grow again."""
        resource.prlimit(self.loop.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)

    def replace_calibration(self, other: Path) -> None:
        """Let the link lead to the folder of another run."""
        new = self.folder / "calibration.new"
        new.symlink_to(other.resolve())
        os.replace(new, self.link)

    # -- what came of it -----------------------------------------------------------------------

    def outcome(self) -> Outcome:
        """Compare record and truth."""
        lines, truth = (
            [json.loads(line) for line in path.read_text().splitlines()]
            for path in (self.output / "focus.jsonl", self.truth)
        )
        records = [line for line in lines if "sequence" in line]
        events = [line["event"] for line in lines if "event" in line]
        return Outcome(self.night, records, events, {one["exposure"]: one for one in truth}, self.peak_mib)


@dataclass(frozen=True)
class Outcome:
    """Records and events of a loop, and the truth by exposure."""

    night: Night
    records: list[dict]
    events: list[str]
    truth: dict[int, dict]
    memory_mib: list[float]

    @property
    def closed_at(self) -> int:
        """First exposure whose residual is within 100 nm."""
        return next(i for i, one in sorted(self.truth.items()) if abs(one["residual_nm"]) < 100)

    def residual_nm(self, exposures: Iterable[int]) -> float:
        """RMS residual of some exposures, what wanders within one included."""
        squares = [self.truth[i]["residual_nm"] ** 2 for i in exposures if i in self.truth]
        return float(np.sqrt(np.mean(squares) + self.night.drift.wander_within_nm2(1.0)))

    def predicted_nm(self) -> float:
        """What linear theory expects, with the noise that the measurements state and that of the sky."""
        sigma = np.median([one["sigma_photon_nm"] for one in self.records if one["valid"]])
        loop = Integrator(GAIN, 1.0, self.night.delay)
        return loop.residual_nm(self.night.drift, float(np.hypot(sigma, SKY_FOCUS_NM)))

    def recovery(self, after: int, limit_nm: float = 40.0) -> int:
        """Exposures from the last one of a fault until the residual is below a limit for three in a row."""
        for index in range(after, self.night.exposures - 3):
            if all(abs(self.truth[i]["residual_nm"]) < limit_nm for i in range(index, index + 3)):
                return index - after
        return -1

    def wrongly_commanded(self) -> int:
        """Records that are not valid and yet changed the offset."""
        pairs = zip(self.records, self.records[1:], strict=False)
        moved = sum(not new["valid"] and new["offset_nm"] != old["offset_nm"] for old, new in pairs)
        return moved + sum(one["commanded"] and not one["valid"] for one in self.records)

    def lost(self) -> set[int]:
        """Exposures without a record."""
        first = FIRST_COUNTER // self.night.reads
        return set(self.truth) - {one["exposure"] - first for one in self.records}

    def sequence_is_whole(self) -> bool:
        """Whether every number of a record is there once."""
        return [one["sequence"] for one in self.records] == list(range(1, len(self.records) + 1))


def _process(arguments: list, log: Path) -> subprocess.Popen:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with open(log, "a") as stream:
        return subprocess.Popen(list(map(str, arguments)), stdout=stream, stderr=stream, env=environment)


def _require_alive(process: subprocess.Popen, log: Path) -> None:
    if process.poll() is not None:
        raise RuntimeError(f"{log}: {log.read_text()[-2000:]}")
