"""A telescope that answers the loop, in one process with it and by a clock of its own.

The light comes from the simulator, which shares no optics with the model of the loop. Reads of a quarter of a
second are tabulated over the defocus once and drawn in random order, so that an hour takes seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast
from unittest import mock
from zlib import crc32

import numpy as np

from benchmarks.focus_loop.telescope import LAYER, Night, kept_table, scene_of
from irlos_pipe.control.controller import ControllerSettings
from irlos_pipe.control.exposures import Read
from irlos_pipe.focus.calibration import Calibration, CalibrationRequest
from irlos_pipe.focus.journal import content_of
from irlos_pipe.focus.mailbox import Mailbox
from irlos_pipe.focus.service import COMMAND, LoopSettings, Service
from irlos_pipe.focus.source import Arrival
from irlos_pipe.paper.common.focus_loop import FrameTable
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.scene import Scene

READS = 4  # reads of an exposure of a second
TABLED_MAG_J = 8.0
REACH_NM, NODES, TABLED_READS = 450.0, 20, 32
NEAR_NM, NEAR_NODES, NEAR_READS = 160.0, 10, 12  # of the tables of scenes with something wrong
USUAL_SEEING = 0.5  # seeing of the calibration
_TABLES: dict[Path, FrameTable] = {}


@dataclass(frozen=True)
class Look:
    """What the telescope sees: `seeing` [arcsec], and `changes` of the scene, unknown to the loop."""

    seeing: float = USUAL_SEEING
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of the file of its table."""
        return f"seeing_{self.seeing}_{crc32(repr(sorted(self.changes.items())).encode()):08x}"


@dataclass(frozen=True)
class Skies:
    """Tables of looks in a `folder`, of the sky of a `seed`."""

    folder: Path
    seed: int

    def table(self, look: Look) -> FrameTable:
        """Return the reads of a `look`; they take a while to simulate."""
        path = self.folder / f"{self.seed}_{look.name}.npz"
        if path not in _TABLES:
            reach_nm, nodes = (NEAR_NM, NEAR_NODES) if look.changes else (REACH_NM, NODES)
            self.folder.mkdir(parents=True, exist_ok=True)
            _TABLES[path] = kept_table(path, lambda: _scene(look, self.seed), reach_nm, nodes)
        return _TABLES[path]

    def exposure_e(
        self, look: Look, mag_j: float, defocus_nm: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, float]:
        """Return the mean electrons of one exposure, without noise, and its defocus with that of the sky."""
        table = self.table(look)
        frames = rng.integers(table.series_e.shape[1], size=READS)
        bounded = np.clip([defocus_nm], -table.reach_nm, table.reach_nm)
        mean_e = sum(table.images_e(frame, bounded)[0] for frame in frames)
        light = 10 ** (0.4 * (TABLED_MAG_J - mag_j))
        return np.maximum(mean_e, 0.0) * light, defocus_nm + float(table.sky_focus_nm[frames].mean())


def noisy_e(mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return what the detector makes of an exposure, (rows, columns) [e-], sky in it.

    Reads are drawn at once, their noises add, so that none of them is clipped by the converter.
    """
    scene = _detector()
    factor, read_e = scene.detector.excess_noise_factor, scene.detector.read_noise_e
    charge_e = rng.poisson(mean_e + (scene.sky_e_per_s + scene.detector.dark_e_per_s) * scene.exposure_s)
    spread_e = np.sqrt((factor - 1) * charge_e + scene.reads * read_e**2)
    return (charge_e - scene.detector.dark_e_per_s + spread_e * rng.standard_normal(mean_e.shape)).astype(
        np.float32
    )


@cache
def _detector() -> Scene:
    return scene_of(Night(reads=1))


def _scene(look: Look, seed: int) -> Scene:
    scene = scene_of(Night(mag_j=TABLED_MAG_J, reads=READS))
    reads = NEAR_READS if look.changes else TABLED_READS
    scene = replace(scene, frames=reads, seed=(seed, 5), sky=Sky(look.seeing))
    changes = {
        key: {**getattr(scene, key), **value} if isinstance(value, dict) else value
        for key, value in look.changes.items()
    }
    return replace(scene, **changes)


# -- the telescope -----------------------------------------------------------------------------

START_UNIX_S = 1.75e9
FIRST_COUNTER = 5000
DELAY, GAIN = 1, 0.4
THERMAL_NM = 0.1  # drift per exposure, on top of the sodium layer's


class FakeTime:
    """Clocks that pass on command."""

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
    """A source of exposures for the loop, see `Source`: right ones, but for a spell."""

    skies: Skies
    mag_j: float
    seed: int
    # Exposures before, in and after the spell.
    before: int = 12
    spell: int = 8
    after: int = 12
    look: Look = field(default_factory=Look)  # of the right exposures
    bad_look: Look | None = None  # of the exposures in the spell
    # What becomes of an image in the spell; gets it, its number there, this object and random numbers.
    spoil: Callable[[np.ndarray, int, Rig, np.random.Generator], np.ndarray] | None = None
    # What arrives in place of a read in the spell.
    arrive: Callable[[Read, int, Rig], Sequence[Arrival]] | None = None
    # Part of a change of the offset that is applied, by the number of the exposure; `late` exposures late.
    answer: Callable[[int], float] = lambda _: 1.0
    late: int = 0
    start_nm: float = 60.0

    def __post_init__(self) -> None:
        self.clock, self.shots, self.images = FakeTime(), list[Shot](), list[np.ndarray]()
        self.rng = np.random.default_rng([self.seed, 11])
        self._exposures = self.before + self.spell + self.after
        steps_nm = LAYER.drift(8.0).draw_nm(np.random.default_rng([self.seed, 12]), self._exposures + 1, 1.0)
        self.drift_nm = self.start_nm + steps_nm + THERMAL_NM * np.arange(self._exposures + 1)
        self._commanded_nm, self.applied_nm, self._index = [0.0] * (DELAY + 1 + self.late), 0.0, 0
        self.command: Mailbox | None = None

    def go_on(self, last: Mapping[str, Any]) -> None:
        """Go on with the counters, the time and the offset of the `last` record of a run as long as this."""
        self._index, self._exposures = self._exposures, 2 * self._exposures
        self.drift_nm = np.full(self._exposures + 1, last["offset_nm"])
        self.clock.passed_s, self.applied_nm = 60.0, last["offset_nm"]
        self._commanded_nm = [last["offset_nm"]] * len(self._commanded_nm)

    def poll(self, timeout_s: float) -> Sequence[Arrival] | None:
        if self._index >= self._exposures:
            return None
        index, self._index = self._index, self._index + 1
        self.clock.passed_s += 1.0
        residual_nm = self.drift_nm[index] - self._applied(index)
        number = index - self.before
        inside = 0 <= number < self.spell
        look = self.bad_look if inside and self.bad_look else self.look
        image_e, defocus_nm = self.image(residual_nm, look)
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
        self.applied_nm += self.answer(index) * (new - old)
        return self.applied_nm


class Outcome(NamedTuple):
    """Records, events and truth of a run."""

    records: list[dict]
    events: list[str]
    shots: list[Shot]


def run(rig: Rig, calibration: Calibration, output: Path, **settings: float) -> Outcome:
    """Let the loop run on a rig, with the `settings` of `LoopSettings`."""
    loop = LoopSettings(ControllerSettings(gain=GAIN, delay=DELAY), **settings)  # type: ignore[arg-type]
    output.mkdir(parents=True, exist_ok=True)
    request = cast(CalibrationRequest, SimpleNamespace(run=output, load=lambda: calibration))
    rig.command = Mailbox(output / COMMAND)
    with rig.clock.running():
        Service(output, request, loop, lambda *_: rig, silent_after_s=10.0).run(lambda _: None)
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


def judged(outcome: Outcome) -> dict[str, Any]:
    """Return the counts of a run.

    Exposures that were ``bad`` and ``right``; bad ones that were commanded although, with a value within its
    error (``commanded_right``) or not (``commanded_wrongly``), and the ``reasons`` why others were not; right
    ones that were not used (``refused``), and those whose value was commanded and is beyond its error
    (``wrong_right``).
    """
    records = {one["counter"]: one for one in outcome.records}
    bad = [(records.get(shot.counter), shot) for shot in outcome.shots if not shot.right]
    right = [(records.get(shot.counter), shot) for shot in outcome.shots if shot.right]
    used = [(record, shot) for record, shot in bad if record is not None and record["valid"]]
    wrong = sum(is_wrong(record, shot) for record, shot in used)
    reasons = sorted({reason for record, _ in bad if record is not None for reason in record["reasons"]})
    return {
        "bad": len(bad),
        "right": len(right),
        "commanded_right": len(used) - wrong,
        "commanded_wrongly": wrong,
        "refused": sum(record is None or not record["valid"] for record, _ in right),
        "wrong_right": sum(
            is_wrong(record, shot) for record, shot in right if record is not None and record["valid"]
        ),
        "reasons": reasons,
    }
