"""What may be wrong with a recording, by family, the kinds of right recordings, and the cases made of them.

What is wrong is either declared wrongly (`*_TOLD`, changes of the side-car), or stands in the images
(`*_SEEN`), or is an effect that nobody declared (`*_HIDDEN`). `NIGHTS` says what was taken in a night.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

from benchmarks.harness import file_name

Change = Mapping[str, Any]
CALIBRATION, RAMP, DIAGNOSIS, NIGHT = "calibration", "ramp", "diagnosis", "night"
BENCH, SKY = "bench", "sky"
RIGHT = "right"
RIGHT_DRAWS = {CALIBRATION: 3, RAMP: 2, DIAGNOSIS: 1, NIGHT: 1}  # right cases in draws of the wrong ones
SKY_ONLY = frozenset({"seeing_arcsec", "shape"})  # keys that a bench does not have

# Changes of a side-car: key, and a number to multiply by or a value to replace.
TOLD: dict[str, Change] = {
    "scale 2 % off": {"pixel_scale_mas": 1.02},
    "scale 5 % off": {"pixel_scale_mas": 0.95},
    "wavelength 2 % off": {"wavelength": 1.02},
    "wavelength 10 % off": {"wavelength": 0.9},
    "wavelength and scale 10 % off": {"wavelength": 1.1, "pixel_scale_mas": 1.1},
    "gain 1e-5": {"e_per_adu": 5e-6},
    "gain 100 times too small": {"e_per_adu": 0.01},
    "gain 1000 times too large": {"e_per_adu": 1e3},
    "read noise 1e4": {"read_noise_e": 1e4},
    "diversity in micrometres": {"diversity": 1e-3},
    "diversity of wrong sign": {"diversity": -1.0},
    "diversity 15 % off": {"diversity": 1.15},
    "diversity of Noll 5": {"noll": 5},
    "diversity not declared": {"diversity": 0.0},
    "exposure in minutes": {"exposure_s": 60.0},
    "role of a ramp": {"role": "defocus_ramp"},
}
SEEN = (
    "flipped left to right",
    "flipped up and down",
    "turned by 180°",
    "transposed",
    "window of 5 λ/D",
    "three frames",
    "frames twice",
    "half of another star",
    "core clipped",
    "jump of 1 px half way",
    "jump of 2 px half way",
    "jump of 3 px half way",
    "two pointings by turns",
    "jumps of 1.5 px",
    "seeing twice as strong half way",
    "defocus of 60 nm more half way",
    "half as bright half way",
)
HIDDEN: dict[str, Change] = {
    "companion 20 %": {"companion": {"flux_ratio": 0.2, "sep_mas": 60.0, "pa_deg": 40.0}},
    "companion 5 %": {"companion": {"flux_ratio": 0.05, "sep_mas": 110.0, "pa_deg": 200.0}},
    "pupil 20 cm off": {"pupil_misregistration": {"dx_m": 0.2, "dy_m": 0.0, "rotation_deg": 0.0}},
    "non-linearity 30 %": {"detector_nonlinearity": {"fraction_at_peak": 0.3}},
    "vibration 15 mas": {"vibration": {"sigma_mas": 15.0, "angle_deg": 30.0}},
    "low wind": {"low_wind_effect": {"piston_nm": [90.0, -60.0, 40.0, -70.0]}},
    "drift of 8 px": {"ncpa_drift": {"zernike_nm": {2: 750.0, 3: -380.0}}},
    "drift of 3 px": {"ncpa_drift": {"zernike_nm": {2: 280.0}}},
}
# Right recordings: changes of the usual one. None is so bright that its sharpest image would saturate.
RIGHTS: dict[str, Change] = {
    "as usual": {},
    "faint": {"mag_j": 11.5},
    "bright": {"mag_j": 7.1},
    "poor seeing": {"seeing_arcsec": 1.2},
    "good seeing": {"seeing_arcsec": 0.35},
    "few frames": {"frames": 10},
    "many frames": {"frames": 120},
    "odd window": {"window": (43, 56)},
    "long exposures": {"exposure_s": 0.3, "mag_j": 9.0},
    "residual along the wind": {"shape": "servo_lag"},
}
# What no cube shows by itself, and the words by which a result says so before its numbers.
INHERENT = {
    "diversity of wrong sign": "sign of the even modes",
    "diversity 15 % off": "size and mode of the diversity",
    "diversity of Noll 5": "size and mode of the diversity",
    "turned by 180°": "turned by 180°",
    "transposed": "transposed",
    "flipped left to right": "mirrored",
    "flipped up and down": "mirrored",
    "wavelength and scale 10 % off": "same factor",
}

# Ramps: `both` says that the calibration cube has the same; the declared offsets are those of `as_told`.
RAMP_TOLD: dict[str, Change] = {
    "offsets of wrong sign": {"offsets": -1.0},
    "offsets × 2": {"offsets": 2.0},
    "offsets × 0.7": {"offsets": 0.7},
    "offsets in micrometres": {"offsets": 1e-3},
    "offsets 60 nm beside": {"beside_nm": 60.0},
    "two offsets exchanged": {"order": (0, 1, 3, 2, 4)},
    "offsets in the wrong order": {"order": (4, 3, 2, 1, 0)},
    "one offset declared as its neighbour": {"order": (0, 1, 3, 3, 4)},
    "diversity of wrong sign in the ramp": {"diversity": -1.0},
    "diversity of wrong sign in ramp and cube": {"diversity": -1.0, "both": True},
    "diversity halved in the ramp": {"diversity": 0.5},
    "diversity of Noll 5 in the ramp": {"noll": 5},
    "diversity 15 % off in ramp and cube": {"diversity": 1.15, "both": True},
    "wavelength 10 % off in the ramp": {"wavelength": 1.1},
    "wavelength 10 % off in ramp and cube": {"wavelength": 1.1, "both": True},
    "scale 5 % off in the ramp": {"pixel_scale_mas": 1.05},
    "scale 5 % off in ramp and cube": {"pixel_scale_mas": 1.05, "both": True},
    "wavelength and scale 10 % off in ramp and cube": {
        "wavelength": 1.1,
        "pixel_scale_mas": 1.1,
        "both": True,
    },
    "gain 100 times too small in the ramp": {"e_per_adu": 0.01},
    "seeing four times too large in the ramp": {"seeing_arcsec": 4.0},
}
RAMP_SEEN: dict[str, Change] = {
    "flipped left to right": {},
    "flipped up and down": {},
    "turned by 180°": {},
    "transposed": {},
    "core clipped": {},
    "transposed in ramp and cube": {"both": True},
    "flipped left to right in ramp and cube": {"both": True},
}
RAMP_HIDDEN: dict[str, Change] = {
    "companion 30 %": {"companion": {"flux_ratio": 0.3, "sep_mas": 190.0, "pa_deg": 40.0}},
    "companion 30 % at λ/D": {"companion": {"flux_ratio": 0.3, "sep_mas": 38.0, "pa_deg": 40.0}},
    "low wind": HIDDEN["low wind"],
    "vibration 20 mas": {"vibration": {"sigma_mas": 20.0, "angle_deg": 30.0}},
    "calibration of another instrument": {},
}
RAMP_INHERENT = {
    "wavelength and scale 10 % off in ramp and cube": "same factor",
    "diversity of wrong sign in ramp and cube": "sign and orientation",
}
RAMP_RIGHTS: dict[str, Change] = {
    "ramp": {},
    "faint ramp": {"mag_j": 11.0},
    "bright ramp": {"mag_j": 8.75},
    "ramp in poor seeing": {"seeing_arcsec": 1.2},
    "ramp in good seeing": {"seeing_arcsec": 0.35},
    "two frames per offset": {"frames": 2},
    "ramp in an odd window": {"window": (43, 56)},
}

# Diagnoses: effects that are not declared, and facts declared wrongly with the right names for them.
DIAGNOSED: dict[str, Change] = {
    name: HIDDEN[name] for name in ("companion 5 %", "low wind", "pupil 20 cm off", "non-linearity 30 %")
} | {
    "vibration 20 mas": {"vibration": {"sigma_mas": 20.0, "angle_deg": 30.0}},
    "ghost 5 %": {"ghost": {"flux_ratio": 0.05, "sep_mas": 120.0, "pa_deg": 300.0, "defocus_nm": 100.0}},
    "bump 200 nm": {"phase_bump": {"nm": 200.0, "x_m": 2.0, "y_m": -1.0, "width_m": 0.5}},
}
SCALES = ("plate_scale", "spectrum")  # degenerate in a narrow band
DIAGNOSED_TOLD: dict[str, tuple[str, ...]] = {
    "scale 2 % off": SCALES,
    "wavelength 2 % off": SCALES,
    "wavelength and scale 10 % off": SCALES,
    "diversity of wrong sign": ("diversity_error",),
    "diversity 15 % off": ("diversity_error",),
}
DIAGNOSED_SEEN: dict[str, tuple[str, ...]] = {
    "transposed": (),
    "flipped left to right": (),
    "half of another star": (),
    "core clipped": ("detector_nonlinearity",),
}
DIAGNOSED_RIGHTS = ("as usual", "bright", "poor seeing", "many frames")


@dataclass(frozen=True)
class Taken:
    """A recording, or all recordings of a ramp."""

    minutes: int = 0  # after the beginning of the night
    # told, hidden: changes of the side-car, and effects that are not declared.
    told: Change = field(default_factory=dict)
    hidden: Change = field(default_factory=dict)
    seen: str = ""  # what is done to the images
    foreign: bool = False  # taken with the NCPAs of another instrument
    # What became of the files: ``cut``, ``no side-car`` (of a ramp: of its third offset) or ``copied``.
    harm: str = ""


EARLY, LATE, RAMP_AT = 60, 110, 120
GOOD, LAST_NIGHT = Taken(EARLY), Taken(EARLY - 24 * 60)
COMPANION = HIDDEN["companion 20 %"]
# Cubes, and the ramp if there is one.
NIGHTS: dict[str, tuple[Sequence[Taken], Taken | None]] = {
    "nearest cube has a companion": ((GOOD, Taken(LATE, hidden=COMPANION)), Taken(RAMP_AT)),
    "only cube has a companion": ((Taken(EARLY, hidden=COMPANION),), Taken(RAMP_AT)),
    "nearest cube is half of another star": (
        (GOOD, Taken(LATE, seen="half of another star")),
        Taken(RAMP_AT),
    ),
    "nearest cube flipped": ((GOOD, Taken(LATE, seen="flipped up and down")), Taken(RAMP_AT)),
    "nearest cube has three frames": ((GOOD, Taken(LATE, seen="three frames")), Taken(RAMP_AT)),
    "nearest cube cut off": ((GOOD, Taken(LATE, harm="cut")), Taken(RAMP_AT)),
    "nearest cube without side-car": ((GOOD, Taken(LATE, harm="no side-car")), Taken(RAMP_AT)),
    "nearest cube of another instrument": ((GOOD, Taken(LATE, foreign=True)), Taken(RAMP_AT)),
    "only cube of another instrument": ((Taken(EARLY, foreign=True),), Taken(RAMP_AT)),
    "cube with a wrong gain": ((Taken(EARLY, told={"e_per_adu": 0.01}),), Taken(RAMP_AT)),
    "scale 5 % off in the cube": ((Taken(EARLY, told={"pixel_scale_mas": 1.05}),), Taken(RAMP_AT)),
    "diversity of wrong sign in the cube": ((Taken(EARLY, told={"diversity": -1.0}),), Taken(RAMP_AT)),
    "diversity of wrong sign in the ramp": ((GOOD,), Taken(RAMP_AT, told={"diversity": -1.0})),
    "offsets of wrong sign": ((GOOD,), Taken(RAMP_AT, told={"offsets": -1.0})),
    "offsets × 2": ((GOOD,), Taken(RAMP_AT, told={"offsets": 2.0})),
    "an offset cut off": ((GOOD,), Taken(RAMP_AT, harm="cut")),
    "an offset without side-car": ((GOOD,), Taken(RAMP_AT, harm="no side-car")),
    "ramp flipped": ((GOOD,), Taken(RAMP_AT, seen="flipped up and down")),
    "no cube": ((), Taken(RAMP_AT)),
}
RIGHT_NIGHTS: dict[str, tuple[Sequence[Taken], Taken | None]] = {
    "night": ((GOOD,), Taken(RAMP_AT)),
    "night of two cubes": ((GOOD, Taken(LATE)), Taken(RAMP_AT)),
    "calibration of the night before": ((LAST_NIGHT,), Taken(RAMP_AT)),
    "night of cubes only": ((GOOD, Taken(LATE)), None),
}
# What no cube of a night shows by itself, and its words.
NIGHT_INHERENT = {
    "diversity of wrong sign in the cube": "sign of the even modes",
    "nearest cube flipped": "mirrored",
}


@dataclass(frozen=True)
class Case:
    """One recording, one ramp with its calibration, or one night."""

    kind: str  # `CALIBRATION`, `RAMP`, `DIAGNOSIS` or `NIGHT`
    family: str  # what is wrong, or `RIGHT` and how
    setting: str  # `BENCH` or `SKY`
    # number, suite_seed: draw of the family, and of all.
    number: int
    suite_seed: int
    usual: Change = field(default_factory=dict)  # changes of the usual simulation
    taken: Taken = field(default_factory=Taken)  # what is wrong
    both: bool = False  # whether the calibration of a ramp has the same
    names: tuple[str, ...] = ()  # effects that a diagnosis may rightly name
    cause: str = ""  # words by which a result says before its numbers that it cannot tell this

    @property
    def right(self) -> bool:
        """Whether nothing is wrong with it."""
        return self.family.startswith(RIGHT)

    @property
    def name(self) -> str:
        """Unique, and fit for a file."""
        return f"{self.kind}.{self.setting}.{file_name(self.family)}.{self.number}"

    @property
    def key(self) -> tuple:
        """What its outcome must say of it."""
        return self.suite_seed, self.name

    @property
    def seed(self) -> int:
        """Of the sky, the wavefront and the noise: the same for all families of a setting and number."""
        return crc32(f"{self.suite_seed}.{self.kind}.{self.setting}.{self.number}".encode())


def all_cases(suite_seed: int, draws: int) -> list[Case]:
    """Return every case in turn: `draws` of each wrong family and setting, and more of the right ones."""
    cases = (
        Case(kind, family, setting, number, suite_seed, **keys)
        for number in range(draws * max(RIGHT_DRAWS.values()))
        for setting in (SKY, BENCH)
        for kind, families in (
            (CALIBRATION, _calibrations(setting)),
            (RAMP, _ramps(setting)),
            (DIAGNOSIS, _diagnoses(setting)),
            (NIGHT, _nights()),
        )
        for family, keys in families
    )
    return [case for case in cases if case.number < draws * (RIGHT_DRAWS[case.kind] if case.right else 1)]


Families = Iterator[tuple[str, dict[str, Any]]]


def _right(changes: Mapping[str, Change], setting: str) -> Families:
    for name, usual in changes.items():
        if setting == SKY or not SKY_ONLY & set(usual):
            yield f"{RIGHT}: {name}", {"usual": usual}


def _calibrations(setting: str) -> Families:
    yield from _right(RIGHTS, setting)
    yield from ((name, {"cause": INHERENT.get(name, "")} | keys) for name, keys in _wrong(TOLD, SEEN, HIDDEN))


def _wrong(told: Iterable[str], seen: Iterable[str], hidden: Mapping[str, Change]) -> Families:
    yield from ((name, {"taken": Taken(told=TOLD[name])}) for name in told)
    yield from ((name, {"taken": Taken(seen=name)}) for name in seen)
    yield from ((name, {"taken": Taken(hidden=change)}) for name, change in hidden.items())


def _ramps(setting: str) -> Families:
    yield from _right(RAMP_RIGHTS, setting)
    for name, told in RAMP_TOLD.items():
        if setting == SKY or not SKY_ONLY & set(told):
            cause = RAMP_INHERENT.get(name, "")
            yield name, {"taken": Taken(told=told), "both": "both" in told, "cause": cause}
    for name, how in RAMP_SEEN.items():
        yield name, {"taken": Taken(seen=name.partition(" in ")[0]), "both": "both" in how}
    yield from ((name, {"taken": Taken(hidden=change)}) for name, change in RAMP_HIDDEN.items())


def _diagnoses(setting: str) -> Families:
    yield from _right({name: RIGHTS[name] for name in DIAGNOSED_RIGHTS}, setting)
    named = DIAGNOSED_TOLD | DIAGNOSED_SEEN | {name: tuple(change) for name, change in DIAGNOSED.items()}
    for name, keys in _wrong(DIAGNOSED_TOLD, DIAGNOSED_SEEN, DIAGNOSED):
        yield name, {"names": named[name], "cause": INHERENT.get(name, "")} | keys


def _nights() -> Families:
    yield from ((f"{RIGHT}: {name}", {}) for name in RIGHT_NIGHTS)
    yield from ((name, {"cause": NIGHT_INHERENT.get(name, "")}) for name in NIGHTS)
