"""All cases of the suite, made from the families."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

from benchmarks.misled import families

CALIBRATION, RAMP, DIAGNOSIS, NIGHT = "calibration", "ramp", "diagnosis", "night"
BENCH, SKY = "bench", "sky"
RIGHT = "right"
RIGHT_DRAWS = {CALIBRATION: 3, RAMP: 2, DIAGNOSIS: 1, NIGHT: 1}  # times those of the wrong ones


@dataclass(frozen=True)
class Case:
    """One recording, one ramp with its calibration, or one night.

    Attributes
    ----------
    kind : str
        `CALIBRATION`, `RAMP`, `DIAGNOSIS` or `NIGHT`.
    family : str
        What is wrong, or `RIGHT` and how.
    setting : str
        `BENCH` or `SKY`.
    number, suite_seed : int
        Draw of the family, and of all.
    usual, told, hidden : mapping
        Changes of the simulation, of the side-car, and effects nobody told.
    seen : str
        What is done to the images.
    both : bool
        The calibration of a ramp has the same.
    names : tuple of str
        Effects that a diagnosis may rightly name.
    cause : str
        Words by which a result says before its numbers that it cannot tell this.
    """

    kind: str
    family: str
    setting: str
    number: int
    suite_seed: int
    usual: dict[str, Any] = field(default_factory=dict)
    told: dict[str, Any] = field(default_factory=dict)
    hidden: dict[str, Any] = field(default_factory=dict)
    seen: str = ""
    both: bool = False
    names: tuple[str, ...] = ()
    cause: str = ""

    @property
    def right(self) -> bool:
        """Whether nothing is wrong with it."""
        return self.family.startswith(RIGHT)

    @property
    def name(self) -> str:
        """Unique, and fit for a file."""
        words = "".join(letter if letter.isalnum() else "_" for letter in self.family)
        return f"{self.kind}.{self.setting}.{words}.{self.number}"

    @property
    def seed(self) -> int:
        """Of the sky, the wavefront and the noise: the same for all families of a setting and number."""
        return crc32(f"{self.suite_seed}.{self.kind}.{self.setting}.{self.number}".encode())


def all_cases(suite_seed: int, draws: int) -> list[Case]:
    """Return every case in turn: `draws` of each wrong family and setting, and more of the right ones."""
    most = draws * max(RIGHT_DRAWS.values())
    cases = [case for number in range(most) for case in _draw(suite_seed, number)]
    return [case for case in cases if case.number < draws * (RIGHT_DRAWS[case.kind] if case.right else 1)]


def _draw(suite_seed: int, number: int) -> Iterator[Case]:
    for setting in (SKY, BENCH):
        for of_kind in (_calibrations, _ramps, _diagnoses, _nights):
            for family, keys in of_kind(setting):
                yield Case(family=family, setting=setting, number=number, suite_seed=suite_seed, **keys)


Drawn = Iterator[tuple[str, dict[str, Any]]]


def _possible(changes: families.Change, setting: str) -> bool:
    return setting == SKY or not families.SKY_ONLY & set(changes)


def _calibrations(setting: str) -> Drawn:
    for name, usual in families.RIGHTS.items():
        if _possible(usual, setting):
            yield f"{RIGHT}: {name}", {"kind": CALIBRATION, "usual": usual}
    for name, keys in _wrong_cubes(families.TOLD, families.SEEN, families.HIDDEN):
        yield name, {"kind": CALIBRATION, "cause": families.INHERENT.get(name, "")} | keys


def _wrong_cubes(told, seen, hidden) -> Drawn:
    yield from ((name, {"told": families.TOLD[name]}) for name in told)
    yield from ((name, {"seen": name}) for name in seen)
    yield from ((name, {"hidden": change}) for name, change in hidden.items())


def _ramps(setting: str) -> Drawn:
    for name, usual in families.RAMP_RIGHTS.items():
        if _possible(usual, setting):
            yield f"{RIGHT}: {name}", {"kind": RAMP, "usual": usual}
    for name, keys in _wrong_ramps():
        if _possible(keys.get("told", {}), setting):
            yield name, {"kind": RAMP, "cause": families.RAMP_INHERENT.get(name, "")} | keys


def _wrong_ramps() -> Drawn:
    for name, told in families.RAMP_TOLD.items():
        yield name, {"told": told, "both": "both" in told}
    for name, how in families.RAMP_SEEN.items():
        yield name, {"seen": name.partition(" in ")[0], "both": "both" in how}
    yield from ((name, {"hidden": change}) for name, change in families.RAMP_HIDDEN.items())


def _diagnoses(setting: str) -> Drawn:
    for name in families.DIAGNOSED_RIGHTS:
        if _possible(families.RIGHTS[name], setting):
            yield f"{RIGHT}: {name}", {"kind": DIAGNOSIS, "usual": families.RIGHTS[name]}
    named = families.DIAGNOSED_TOLD | families.DIAGNOSED_SEEN
    named |= {name: tuple(change) for name, change in families.DIAGNOSED.items()}
    wrong = _wrong_cubes(families.DIAGNOSED_TOLD, families.DIAGNOSED_SEEN, families.DIAGNOSED)
    for name, keys in wrong:
        cause = families.INHERENT.get(name, "")
        yield name, {"kind": DIAGNOSIS, "names": named[name], "cause": cause} | keys


def _nights(setting: str) -> Drawn:
    yield from ((f"{RIGHT}: {name}", {"kind": NIGHT}) for name in families.RIGHT_NIGHTS)
    for name in families.NIGHTS:
        yield name, {"kind": NIGHT, "cause": families.NIGHT_INHERENT.get(name, "")}
