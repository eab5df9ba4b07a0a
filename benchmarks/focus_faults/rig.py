"""A telescope that answers the loop, in one process with it and by a clock of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast
from unittest import mock

import numpy as np

from benchmarks.focus_faults.sky import Look, Skies, noisy_e
from benchmarks.focus_loop.telescope import LAYER
from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.control.exposures import Read
from irlos_pipe.focus.calibration import Calibration, CalibrationRequest
from irlos_pipe.focus.loop import LoopSettings
from irlos_pipe.focus.mailbox import Mailbox
from irlos_pipe.focus.record import content_of
from irlos_pipe.focus.service import COMMAND, Service
from irlos_pipe.focus.source import Arrival

START_UNIX_S = 1.75e9
FIRST_COUNTER = 5000
DELAY, GAIN = 1, 0.4
THERMAL_NM = 0.1  # drift per exposure, beside the sodium layer's


class FakeTime:
    """Clocks that pass when they are told to."""

    def __init__(self) -> None:
        self.passed_s, self.set_s = 0.0, 0.0

    def time(self) -> float:
        """Return the time since 1970."""
        return START_UNIX_S + self.passed_s + self.set_s

    def monotonic(self) -> float:
        """Return the time that has passed."""
        return 1000.0 + self.passed_s

    @contextmanager
    def running(self) -> Iterator[None]:
        """Take the place of the machine's clocks."""
        with mock.patch("time.time", self.time), mock.patch("time.monotonic", self.monotonic):
            yield


@dataclass
class Shot:
    """One exposure as it was: number, true defocus of its light with the sky's, and whether it is right."""

    counter: int
    defocus_nm: float
    right: bool


@dataclass
class Rig:
    """A source of exposures for the loop, see `Source`: right ones, but for a spell.

    Attributes
    ----------
    skies : Skies
    mag_j : float
    before, spell, after : int
        Exposures.
    look : Look
        Of the right ones.
    bad_look : Look or None
        Of those of the spell.
    spoil : callable
        What becomes of an image in the spell; gets it, its number there, this object and random numbers.
    arrive : callable
        What arrives in place of a read in the spell.
    answer : callable
        Part of a change of the offset that is applied, by the number of the exposure; `late` exposures late.
    """

    skies: Skies
    mag_j: float
    seed: int
    before: int = 12
    spell: int = 8
    after: int = 12
    look: Look = field(default_factory=Look)
    bad_look: Look | None = None
    spoil: Callable[[np.ndarray, int, Rig, np.random.Generator], np.ndarray] | None = None
    arrive: Callable[[Read, int, Rig], Sequence[Arrival]] | None = None
    answer: Callable[[int], float] = lambda _: 1.0
    late: int = 0
    start_nm: float = 60.0

    def __post_init__(self) -> None:
        self.clock, self.shots, self.images = FakeTime(), list[Shot](), list[np.ndarray]()
        self.rng = np.random.default_rng([self.seed, 11])
        self._exposures = self.before + self.spell + self.after
        steps_nm = LAYER.drift(8.0).draw_nm(np.random.default_rng([self.seed, 12]), self._exposures + 1, 1.0)
        self.drift_nm = self.start_nm + steps_nm + THERMAL_NM * np.arange(self._exposures + 1)
        self._commanded_nm, self._applied_nm, self._index = [0.0] * (DELAY + 1 + self.late), 0.0, 0
        self.command: Mailbox | None = None

    def poll(self, timeout_s: float) -> Sequence[Arrival] | None:
        """See `Source.poll`."""
        if self._index >= self._exposures:
            return None
        index, self._index = self._index, self._index + 1
        self.clock.passed_s += 1.0
        residual_nm = self.drift_nm[index] - self._applied(index)
        number = index - self.before
        inside = 0 <= number < self.spell
        image_e, defocus_nm = self.image(
            residual_nm, self.bad_look if inside and self.bad_look else self.look
        )
        harmed = inside and (self.spoil is not None or self.bad_look is not None)
        if inside and self.spoil is not None:
            image_e = self.spoil(image_e, number, self, self.rng)
        self.images = [*self.images[-8:], image_e]
        read = Read(FIRST_COUNTER + index, self.clock.time() - self.clock.set_s - 0.5, image_e)
        self.shots.append(Shot(read.counter, defocus_nm, not harmed))
        return self.arrive(read, number, self) if inside and self.arrive is not None else [read]

    def close(self) -> None:
        """See `Source.close`."""

    def image(self, residual_nm: float, look: Look) -> tuple[np.ndarray, float]:
        """Return an exposure with its noise, and the defocus of its light."""
        mean_e, defocus_nm = self.skies.exposure_e(look, self.mag_j, residual_nm, self.rng)
        return noisy_e(mean_e, self.rng), defocus_nm

    def _applied(self, index: int) -> float:
        """The offset that the focus has taken, with what was commanded in time."""
        found = None if self.command is None else self.command.read()
        self._commanded_nm.append(self._commanded_nm[-1] if found is None else found.offset_nm)
        new, old = self._commanded_nm[-1 - DELAY - self.late], self._commanded_nm[-2 - DELAY - self.late]
        self._applied_nm += self.answer(index) * (new - old)
        return self._applied_nm


@dataclass(frozen=True)
class Ready:
    """A request whose calibration is there already."""

    run: Path
    found: Calibration

    def load(self) -> Calibration:
        """Return it."""
        return self.found


@dataclass(frozen=True)
class Outcome:
    """Records, events and truth of a run."""

    records: list[dict]
    events: list[str]
    shots: list[Shot]


def run(rig: Rig, calibration: Calibration, output: Path, **settings: float) -> Outcome:
    """Let the loop run on a rig, with the `settings` of `LoopSettings`."""

    def opened(*_: object) -> Rig:
        return rig

    loop = LoopSettings(ControllerSettings(gain=GAIN, delay=DELAY), **settings)  # type: ignore[arg-type]
    output.mkdir(parents=True, exist_ok=True)
    request = cast(CalibrationRequest, Ready(output, calibration))
    rig.command = Mailbox(output / COMMAND)
    with rig.clock.running():
        Service(output, request, loop, opened, silent_after_s=10.0).run(lambda _: None)
    rig.command.close()
    return outcome_of(output, rig.shots)


def outcome_of(output: Path, shots: list[Shot]) -> Outcome:
    """Read what a loop has recorded; lines that were damaged are left out."""
    lines = []
    for line in (output / "focus.jsonl").read_bytes().splitlines():
        with suppress(ValueError):
            lines.append(content_of(line))
    records = [one for one in lines if "sequence" in one]
    return Outcome(records, [one["event"] for one in lines if "event" in one], shots)


def is_wrong(record: dict, shot: Shot, sigmas: float = 3.0, least_nm: float = 5.0) -> bool:
    """Return whether a measurement is off by more than it says, and by more than matters."""
    error_nm = abs((record["defocus_nm"] or math.nan) - shot.defocus_nm)
    return not (error_nm <= sigmas * (record["sigma_nm"] or 0.0) or error_nm <= least_nm)
