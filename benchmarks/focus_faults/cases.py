"""All cases: what goes wrong with the light, the pixels, the counters, the clocks and the focus itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from zlib import crc32

from benchmarks.focus_faults import spoiling
from benchmarks.focus_faults.rig import FIRST_COUNTER, Rig
from benchmarks.focus_faults.sky import Look, Skies
from irlos_pipe.control.exposures import Read
from irlos_pipe.focus.source import Arrival

LIGHT, TIMES, FOCUS = "light", "times", "focus"
MAGNITUDES = (9.0, 12.0, 15.0)
HOUR = 3600


@dataclass(frozen=True)
class Case:
    """One run of the loop.

    Attributes
    ----------
    kind, family : str
    known : bool
        Of a kind that was asked for by name; others are further ones.
    mag_j : float
    changes : dict
        Of the `Rig`.
    lost : int
        Right exposures that may go by unused, until a recorder that jumps is followed again.
    told : str
        Words that an event must hold; empty if none is asked.
    """

    kind: str
    family: str
    known: bool
    mag_j: float
    changes: dict[str, Any] = field(default_factory=dict)
    lost: int = 0
    told: str = ""

    @property
    def name(self) -> str:
        """Unique, and fit for a folder."""
        words = "".join(letter if letter.isalnum() else "_" for letter in self.family)
        return f"{self.kind}.{words}.{self.mag_j:g}"

    def rig(self, skies: Skies) -> Rig:
        """Return the telescope of the case."""
        seed = crc32(f"{skies.seed}.{self.name}".encode())
        return Rig(skies, self.mag_j, seed, **self.changes)


def all_cases() -> list[Case]:
    """Return every case."""
    return [*_of_light(), *_of_times(), *_of_focus()]


def hours(
    seeings: Sequence[float], magnitudes: Sequence[float]
) -> Iterator[tuple[str, float, float, dict[str, Any]]]:
    """Yield name, seeing, magnitude and rig of hours of right exposures."""
    for seeing in seeings:
        for mag_j in magnitudes:
            yield (
                f"{seeing}_{mag_j}",
                seeing,
                mag_j,
                {"before": HOUR, "spell": 0, "after": 0, "look": Look(seeing)},
            )


def _of_light() -> Iterator[Case]:
    for known, pixels, looks in (
        (True, spoiling.PIXELS, spoiling.LOOKS),
        (False, spoiling.MORE_PIXELS, spoiling.MORE_LOOKS),
    ):
        for mag_j in MAGNITUDES:
            for family, spoil in pixels.items():
                told = "frozen" if family.startswith("frozen") else ""
                yield Case(LIGHT, family, known, mag_j, {"spoil": spoil}, told=told)
            for family, changes in looks.items():
                yield Case(LIGHT, family, known, mag_j, {"bad_look": Look(changes=changes)})


Arrive = Callable[[Read, int, Rig], Sequence[Arrival]]


def _once(**changes: Callable[[Read], Any]) -> Arrive:
    """The first read of the spell changed, the others as they are."""

    def arrive(read: Read, number: int, rig: Rig) -> list[Arrival]:
        if number:
            return [read]
        rig.shots[-1].right = False
        return [replace(read, **{key: change(read) for key, change in changes.items()})]

    return arrive


def _counter(change: Callable[[int], int]) -> Arrive:
    """All reads of the spell with other counters."""

    def arrive(read: Read, number: int, rig: Rig) -> list[Arrival]:
        rig.shots[-1].counter = change(read.counter)
        return [replace(read, counter=change(read.counter))]

    return arrive


def _set(seconds: float) -> Arrive:
    """The clock of the loop is set, and the recorder's is not."""

    def arrive(read: Read, number: int, rig: Rig) -> list[Arrival]:
        rig.clock.set_s = seconds
        return [read]

    return arrive


def _dated(seconds: float) -> Arrive:
    """The clock of the recorder is off."""

    def arrive(read: Read, number: int, rig: Rig) -> list[Arrival]:
        rig.shots[-1].right = seconds < 0
        return [replace(read, unix_s=read.unix_s + seconds)]

    return arrive


def _late(read: Read, number: int, rig: Rig) -> list[Arrival]:
    rig.shots[-1].right = False
    return [replace(read, counter=read.counter - 3000, unix_s=read.unix_s - 3000)]


def _again(read: Read, number: int, rig: Rig) -> list[Arrival]:
    """Old pixels with new counters and times, one between two new ones."""
    if number % 2 == 0:
        return [read]
    rig.shots[-1].right = False
    return [replace(read, image_e=rig.images[-4])]


def _of_times() -> Iterator[Case]:
    for known, family, arrive, lost, told, spell in (
        (
            True,
            "counter and time ahead",
            _once(counter=lambda r: r.counter + 10**5, unix_s=lambda r: r.unix_s + 3600),
            0,
            "ahead",
            20,
        ),
        (
            True,
            "counter and time far ahead",
            _once(counter=lambda r: r.counter + 10**7, unix_s=lambda r: r.unix_s + 1e9),
            0,
            "ahead",
            20,
        ),
        (True, "counter ahead once", _once(counter=lambda r: r.counter + 10**5), 4, "went back", 20),
        (False, "counter of 2^62 once", _once(counter=lambda r: 2**62), 4, "went", 20),
        (False, "counter of -2^63 once", _once(counter=lambda r: -(2**63)), 0, "", 20),
        (True, "late reads for long", _late, 0, "no frames for 10 s", 15),
        (False, "dated an hour ahead for a while", _dated(3600.0), 0, "ahead", 12),
        (False, "dated a year back for a while", _dated(-3e7), 0, "", 12),
        (False, "old pixels between new ones", _again, 0, "frozen", 12),
        (
            False,
            "recorder counts anew",
            _counter(lambda counter: counter - FIRST_COUNTER),
            4,
            "went back",
            20,
        ),
        (False, "recorder counts on from elsewhere", _counter(lambda counter: counter + 10**6), 0, "", 20),
        (False, "every read twice", lambda read, number, rig: [read, read], 0, "", 12),
        (False, "without times", _once(unix_s=lambda r: float("nan")), 0, "", 12),
        *(
            (False, f"clock of the loop set by {words}", _set(seconds), 0, "the clock was set", 12)
            for words, seconds in {
                "an hour on": 3600.0,
                "an hour back": -3600.0,
                "60 days on": 5.2e6,
                "10 years back": -3.15e8,
                "below zero": -1.76e9,
            }.items()
        ),
    ):
        after = 0 if "counts" in family else 8
        yield Case(TIMES, family, known, 12.0, {"arrive": arrive, "spell": spell, "after": after}, lost, told)


def _of_focus() -> Iterator[Case]:
    told = "the loop is not closed"
    wrong: dict[str, dict[str, Any]] = {
        "stage stuck": {"answer": lambda index: float(index < 30)},
        "stage stuck from the start": {"answer": lambda index: 0.0},
        "stage stuck from the start, far away": {"answer": lambda index: 0.0, "start_nm": 300.0},
        "offsets of the wrong sign": {"answer": lambda index: 1.0 if index < 30 else -1.0},
        "offsets of the wrong sign from the start": {"answer": lambda index: -1.0},
        "offsets applied twice": {"answer": lambda index: 1.0 if index < 30 else 2.0},
        "offsets half applied": {"answer": lambda index: 0.5},
        "offsets applied by 120 %": {"answer": lambda index: 1.2},
        "offsets an exposure late": {"late": 1},
        "far away": {"start_nm": 300.0},
    }
    fine = ("offsets half applied", "offsets applied by 120 %", "offsets an exposure late", "far away")
    for mag_j in (9.0, 15.0, 17.0):
        for family, changes in wrong.items():
            spell = {"before": 30, "spell": 470, "after": 0}
            words = "" if family in fine else told
            yield Case(FOCUS, family, "stuck" in family, mag_j, spell | changes, told=words)
