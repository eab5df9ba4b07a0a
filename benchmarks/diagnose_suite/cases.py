"""All cases of the suite, as a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import Any
from zlib import crc32

from benchmarks.diagnose_suite.foreign import FOREIGN
from benchmarks.diagnose_suite.hidden import DRAWS, STAGE
from benchmarks.diagnose_suite.levels import LEVELS, MEDIUM
from benchmarks.diagnose_suite.settings import SETTINGS, Setting

CLEAN, SINGLE, PAIR, OUTSIDE = "clean", "single", "pair", "outside"
RAMP_CLEAN, RAMP_SINGLE, RAMP_OUTSIDE = "ramp_clean", "ramp_single", "ramp_outside"
RAMPS = (RAMP_CLEAN, RAMP_SINGLE, RAMP_OUTSIDE)
MIXED_UP = "frame_order"
CLEAN_EACH, RAMPS_CLEAN_EACH, MIXED_UP_EACH = 12, 4, 3
RAMP_SETTINGS = ("bench_narrow", "sky_broad")
PAIRS = (
    ("companion", "vibration"),
    ("companion", "low_wind_effect"),
    ("vibration", "phase_bump"),
    ("tip_tilt_jitter", "companion"),
    ("low_wind_effect", "background_gradient"),
    ("phase_bump", "companion"),
    ("pupil_misregistration", "vibration"),
    ("detector_nonlinearity", "companion"),
    ("interpixel_crosstalk", "low_wind_effect"),
    ("bad_pixels", "companion"),
    ("ncpa_drift", "vibration"),
    ("amplitude_aberration", "companion"),
)
# What the recipe for the sky has in its model already: there the model goes without it.
IN_SKY_MODEL = ("seeing_halo", "tip_tilt_jitter")


@dataclass(frozen=True)
class Case:
    """One recording, or one ramp with its calibration.

    Attributes
    ----------
    kind : str
        `CLEAN`, `SINGLE`, …
    setting : Setting
    effects : tuple of str
        Hidden effects: of the catalogue, or one that it does not have.
    level : str
        Of all hidden effects; empty without.
    number : int
        Distinguishes draws of the same case.
    dirty : bool
        Whether everything has a mild error beside what is hidden.
    suite_seed : int
        Of all draws; the same case with another seed is another recording.
    """

    kind: str
    setting: Setting
    effects: tuple[str, ...] = ()
    level: str = ""
    number: int = 0
    dirty: bool = False
    suite_seed: int = 0

    @property
    def name(self) -> str:
        """Of its files: ``single.bench_narrow.companion.weak``, ``dirty.single.…``."""
        world = "dirty" if self.dirty else ""
        last = self.level if self.kind in (SINGLE, RAMP_SINGLE) else f"{self.number:02d}"
        parts = (world, self.kind, self.setting.name, "+".join(self.effects), last)
        return ".".join(part for part in parts if part)

    @property
    def seed(self) -> int:
        """The same in every run of one suite seed, its own in every case."""
        return crc32(self.name.encode(), self.suite_seed)

    @property
    def is_ramp(self) -> bool:
        """Whether it is a ramp."""
        return self.kind in RAMPS

    @property
    def model_effects(self) -> tuple[str, ...] | None:
        """Of the model to begin with, where it is not the recipe's."""
        hidden = set(self.effects) & set(IN_SKY_MODEL)
        if self.is_ramp:
            return None if self.setting.on_sky else ()
        return tuple(n for n in IN_SKY_MODEL if n not in hidden) if self.setting.on_sky and hidden else None

    def true_model(self, known: Mapping[str, Mapping[str, Any]]) -> list[Any]:
        """Effects of a model that lacks nothing: what a recipe has anyway, and what is hidden as it is."""
        usual = IN_SKY_MODEL if self.setting.on_sky else ()
        return [*usual, *({effect: dict(value)} for effect, value in known.items() if effect not in usual)]


def all_cases(suite_seed: int = 0, dirty: bool = False) -> list[Case]:
    """Every case: those of one kind together, settings in turn.

    Parameters
    ----------
    suite_seed : int
    dirty : bool
        All cases with mild errors, after the clean recordings without any, whose smallest detectable sizes
        show what these errors cost.
    """
    cases = [*_clean(), *_singles(), *_pairs(), *_outside(), *_ramps()]
    seeded = [replace(case, suite_seed=suite_seed) for case in cases]
    if not dirty:
        return seeded
    clean = [case for case in seeded if case.kind in (CLEAN, RAMP_CLEAN)]
    return clean + [replace(case, dirty=True) for case in seeded]


def in_one_setting(cases: Sequence[Case]) -> list[Case]:
    """Every case in one of its settings, which take turns.

    Parameters
    ----------
    cases : sequence of Case
        As `all_cases` has them: settings of one case together.
    """
    groups = groupby(cases, lambda one: (one.dirty, one.kind, one.effects, one.level, one.number))
    alike = [list(group) for _, group in groups]
    return [some[number % len(some)] for number, some in enumerate(alike)]


def _clean() -> Iterator[Case]:
    for number, setting in product(range(CLEAN_EACH), SETTINGS.values()):
        yield Case(CLEAN, setting, number=number)


def _singles() -> Iterator[Case]:
    effects = [name for name in DRAWS if name not in STAGE]
    for effect, level, setting in product(effects, LEVELS, SETTINGS.values()):
        yield Case(SINGLE, setting, (effect,), level)


def _pairs() -> Iterator[Case]:
    """Every pair in two settings, on the bench and on sky."""
    settings = list(SETTINGS.values())
    for index, pair in enumerate(PAIRS):
        for setting in (settings[index % 2], settings[3 - index % 2]):
            yield Case(PAIR, setting, pair, MEDIUM)


def _outside() -> Iterator[Case]:
    for effect, setting in product(FOREIGN, SETTINGS.values()):
        yield Case(OUTSIDE, setting, (effect,))


def _ramps() -> Iterator[Case]:
    settings = [SETTINGS[name] for name in RAMP_SETTINGS]
    for number, setting in product(range(RAMPS_CLEAN_EACH), settings):
        yield Case(RAMP_CLEAN, setting, number=number)
    for effect, level, setting in product(STAGE, LEVELS, settings):
        yield Case(RAMP_SINGLE, setting, (effect,), level)
    for number, setting in product(range(MIXED_UP_EACH), settings):
        yield Case(RAMP_OUTSIDE, setting, (MIXED_UP,), number=number)
