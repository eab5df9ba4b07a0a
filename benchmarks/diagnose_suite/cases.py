"""All cases of the suite: under which conditions, what is hidden, and how large it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import Any
from zlib import crc32

import numpy as np

from benchmarks.diagnose_suite.foreign import FOREIGN

RAMP_FRAMES = 8  # frames at every offset
EXPOSURE_S = 0.1  # exposure of a frame; on sky ten screens long
# Up and down between each other, so that every direction of travel meets every part of the ramp.
OFFSETS_NM = (-300, -200, -100, 0, 100, 200, 300, 250, 150, 50, -50, -150, -250)
BENCH, SKY = "bench", "sky"
NARROW, BROAD = "narrow_h", "j_h"
DIVERSITY_NM = {6: -170.0}
SEEING_ARCSEC, NCPA_NM, MOTION_MAS = (0.4, 0.8), (80.0, 160.0), (5.0, 9.0)  # ranges from which they are drawn
WAVELENGTHS_PER_BAND = 11
SKY_PUPIL_SAMPLES = 96  # 4.5 times what the window needs at the shortest wavelength


@dataclass(frozen=True)
class Setting:
    """One class of recordings: on the bench photons set the limit, on sky (AO residual, motion) speckles do.

    The stars give 1.3 to 1.5 million photo-electrons per frame; `window` is rows and columns [px].
    """

    where: str
    bands: str
    mag_j: float
    frames: int = 120
    window: int = 64

    @property
    def name(self) -> str:
        """For case names: ``bench_narrow``."""
        return f"{self.where}_{'narrow' if self.bands == NARROW else 'broad'}"

    @property
    def on_sky(self) -> bool:
        """Whether there is an AO residual."""
        return self.where == SKY

    @property
    def recipe(self) -> str:
        """That diagnoses a cube of this class."""
        return "diagnose" if self.on_sky else "diagnose_bench"

    @property
    def highest_noll(self) -> int:
        """Mode up to which that recipe's model reaches."""
        return 66 if self.on_sky else 30

    @property
    def hidden_nolls(self) -> range:
        """Modes in which `high_order_ncpa` is drawn: the radial order beyond the model's."""
        return range(67, 79) if self.on_sky else range(31, 37)

    def sections(self, rng: np.random.Generator) -> dict[str, Mapping[str, Any]]:
        """What all recordings of a case share, as a simulation spec has it."""
        ncpa = {"total_nm": float(rng.uniform(*NCPA_NM)), "modes": 50 if self.on_sky else 29}
        common = {
            "ncpa": ncpa,
            "diversity": {"source": "lens", "zernike": DIVERSITY_NM},
            "detector": {"e_per_adu": 2.0, "read_noise_e": 1.0},
        }
        if not self.on_sky:
            return common | {"sampling": {"points_per_band": WAVELENGTHS_PER_BAND}}
        wind = {"wind_m_s": float(rng.uniform(6, 14)), "wind_angle_deg": float(rng.uniform(0, 360))}
        return common | {
            "sky": {"seeing_arcsec": float(rng.uniform(*SEEING_ARCSEC)), **wind},
            "motion": {"rms_mas": float(rng.uniform(*MOTION_MAS))},
            "sampling": {"points_per_band": WAVELENGTHS_PER_BAND, "pupil_samples": SKY_PUPIL_SAMPLES},
        }

    def recording(self) -> dict[str, Any]:
        """Of the spec's recordings: a star and its exposures."""
        return {
            "role": "ncpa_calibration",
            "mag_j": self.mag_j,
            "bands": self.bands,
            "frames": self.frames,
            "exposure_s": EXPOSURE_S,
            "window": [self.window, self.window],
        }


SETTINGS = {
    one.name: one
    for one in (
        Setting(BENCH, NARROW, 8.0),
        Setting(BENCH, BROAD, 10.0),
        Setting(SKY, NARROW, 8.0),
        Setting(SKY, BROAD, 10.0),
    )
}

# -- how large hidden effects are --------------------------------------------------------------
#
# Weak is about four times the smallest detectable size that `diagnose` prints for clean recordings of the
# setting, medium and strong are what instruments are known to do. Where a size is no single number: RMS of
# the modes or petals, displacement of the stop.

MEDIUM = "medium"
LEVELS = ("weak", MEDIUM, "strong")
# Effect: sizes in every setting; by setting where they differ.
SIZES: dict[str, dict[str, tuple[float, float, float]]] = {
    "tip_tilt_jitter": {"bench": (1.6, 4.0, 9.0), "sky": (5.0, 8.0, 12.0)},  # mas
    "vibration": {"bench": (2.0, 5.0, 10.0), "sky": (10.0, 20.0, 30.0)},  # mas
    "seeing_halo": {"bench": (30.0, 60.0, 110.0), "sky": (95.0, 120.0, 150.0)},  # nm RMS
    "atmospheric_dispersion": {  # mas/µm
        "bench_narrow": (60.0, 150.0, 400.0),
        "bench_broad": (0.5, 4.0, 30.0),
        "sky_narrow": (600.0, 900.0, 1800.0),
        "sky_broad": (9.0, 25.0, 80.0),
    },
    "spectrum": {  # nm in a narrow band, 1/µm between J and H
        "bench_narrow": (1.0, 5.0, 20.0),
        "bench_broad": (0.02, 0.1, 0.5),
        "sky_narrow": (12.0, 30.0, 60.0),
        "sky_broad": (0.5, 0.9, 1.5),
    },
    "plate_scale": {"bench": (0.0005, 0.003, 0.015), "sky": (0.0075, 0.012, 0.02)},
    "anamorphism": {"bench": (0.0015, 0.006, 0.03), "sky": (0.02, 0.035, 0.05)},
    "diversity_error": {"bench": (5.0, 15.0, 40.0), "sky": (5.0, 15.0, 40.0)},  # nm
    "pupil_misregistration": {"bench": (0.02, 0.06, 0.2), "sky": (0.1, 0.2, 0.35)},  # m
    "pupil_geometry": {"bench": (0.035, 0.1, 0.25), "sky": (0.17, 0.28, 0.45)},  # m of the hole
    "amplitude_aberration": {"bench": (0.004, 0.02, 0.06), "sky": (0.05, 0.08, 0.12)},
    "low_wind_effect": {"bench": (6.0, 30.0, 100.0), "sky": (65.0, 110.0, 180.0)},  # nm
    "high_order_ncpa": {"bench": (1.0, 6.0, 25.0), "sky": (10.0, 20.0, 35.0)},  # nm RMS
    "phase_bump": {"bench": (12.0, 50.0, 150.0), "sky": (200.0, 400.0, 600.0)},  # nm
    "pupil_spot": {"bench": (0.025, 0.1, 0.5), "sky": (0.5, 0.75, 1.0)},  # opacity
    "ncpa_drift": {"bench": (4.0, 15.0, 40.0), "sky": (25.0, 50.0, 90.0)},  # nm RMS
    "chromatic_ncpa": {  # nm RMS per µm
        "bench_narrow": (50.0, 150.0, 400.0),
        "bench_broad": (5.0, 30.0, 120.0),
        "sky_narrow": (50.0, 150.0, 400.0),
        "sky_broad": (50.0, 100.0, 200.0),
    },
    "filter_ncpa": {"bench": (5.0, 15.0, 40.0), "sky": (5.0, 15.0, 40.0)},  # nm RMS
    "companion": {"bench": (0.0003, 0.005, 0.05), "sky": (0.005, 0.02, 0.08)},
    "ghost": {"bench": (0.0003, 0.005, 0.05), "sky": (0.005, 0.02, 0.08)},
    "interpixel_crosstalk": {"bench": (0.012, 0.03, 0.08), "sky": (0.05, 0.1, 0.18)},
    "detector_nonlinearity": {"bench": (0.01, 0.03, 0.1), "sky": (0.1, 0.17, 0.24)},
    "background_gradient": {"bench": (0.01, 0.1, 1.0), "sky": (0.12, 0.4, 1.5)},  # e-/px
    "bad_pixels": {"bench": (100.0, 500.0, 3000.0), "sky": (300.0, 1000.0, 5000.0)},  # e-
    "focus_stage_hysteresis": {"bench": (15.0, 30.0, 60.0), "sky": (15.0, 30.0, 60.0)},  # nm
    "focus_stage_offset": {"bench": (15.0, 40.0, 100.0), "sky": (15.0, 40.0, 100.0)},  # nm
    "focus_stage_scale": {"bench": (0.08, 0.15, 0.25), "sky": (0.08, 0.15, 0.25)},
}


def size_of(effect: str, setting: str, level: str) -> float:
    """Size of an effect at a level, before it is drawn about it."""
    sizes = SIZES[effect]
    of_setting = sizes[setting] if setting in sizes else sizes[setting.partition("_")[0]]
    return of_setting[LEVELS.index(level)]


# -- the table of cases ------------------------------------------------------------------------

CLEAN, SINGLE, PAIR, OUTSIDE = "clean", "single", "pair", "outside"
RAMP_CLEAN, RAMP_SINGLE, RAMP_OUTSIDE = "ramp_clean", "ramp_single", "ramp_outside"
RAMPS = (RAMP_CLEAN, RAMP_SINGLE, RAMP_OUTSIDE)
MIXED_UP = "frame_order"
STAGE = ("focus_stage_hysteresis", "focus_stage_offset", "focus_stage_scale")  # effects of ramps
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
    """One recording, or one ramp with its calibration."""

    kind: str
    setting: Setting
    effects: tuple[str, ...] = ()  # hidden effects: of the catalogue, or one that it does not have
    level: str = ""  # level of all hidden effects; empty without
    number: int = 0  # distinguishes draws of the same case
    dirty: bool = False  # whether everything has a mild error besides what is hidden
    suite_seed: int = 0  # seed of all draws; the same case with another seed is another recording

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
    def key(self) -> tuple:
        """What its outcome must say of it."""
        return self.suite_seed, self.name

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

    `dirty` are all cases with mild errors, after the clean recordings without any, whose smallest detectable
    sizes show what these errors cost.
    """
    seeded = [replace(case, suite_seed=suite_seed) for case in _cases()]
    if not dirty:
        return seeded
    clean = [case for case in seeded if case.kind in (CLEAN, RAMP_CLEAN)]
    return clean + [replace(case, dirty=True) for case in seeded]


def in_one_setting(cases: Sequence[Case]) -> list[Case]:
    """Every case in one of its settings, which take turns; `cases` in the order of `all_cases`."""
    groups = groupby(cases, lambda one: (one.dirty, one.kind, one.effects, one.level, one.number))
    equal = [list(group) for _, group in groups]
    return [some[number % len(some)] for number, some in enumerate(equal)]


def _cases() -> Iterator[Case]:
    settings, of_ramps = list(SETTINGS.values()), [SETTINGS[name] for name in RAMP_SETTINGS]
    for number, setting in product(range(CLEAN_EACH), settings):
        yield Case(CLEAN, setting, number=number)
    for effect, level, setting in product([name for name in SIZES if name not in STAGE], LEVELS, settings):
        yield Case(SINGLE, setting, (effect,), level)
    for index, pair in enumerate(PAIRS):  # every pair on the bench and on sky
        for setting in (settings[index % 2], settings[3 - index % 2]):
            yield Case(PAIR, setting, pair, MEDIUM)
    for effect, setting in product(FOREIGN, settings):
        yield Case(OUTSIDE, setting, (effect,))
    for number, setting in product(range(RAMPS_CLEAN_EACH), of_ramps):
        yield Case(RAMP_CLEAN, setting, number=number)
    for effect, level, setting in product(STAGE, LEVELS, of_ramps):
        yield Case(RAMP_SINGLE, setting, (effect,), level)
    for number, setting in product(range(MIXED_UP_EACH), of_ramps):
        yield Case(RAMP_OUTSIDE, setting, (MIXED_UP,), number=number)
