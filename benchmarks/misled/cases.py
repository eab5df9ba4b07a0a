"""All cases of the suite: right recordings of every kind, and what may be wrong with one, by family.

What is wrong is either told wrongly (`TOLD`, changes of the side-car), or stands in the images (`SEEN`), or
is an effect that nobody told (`HIDDEN`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

CALIBRATION, RAMP, DIAGNOSIS = "calibration", "ramp", "diagnosis"
BENCH, SKY = "bench", "sky"
RIGHT = "right"
# Changes of a side-car: key, and a number to multiply by or a value to replace.
TOLD: dict[str, dict[str, Any]] = {
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
    "diversity not told": {"diversity": 0.0},
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
)
HIDDEN: dict[str, dict[str, Any]] = {
    "companion 20 %": {"companion": {"flux_ratio": 0.2, "sep_mas": 60.0, "pa_deg": 40.0}},
    "companion 5 %": {"companion": {"flux_ratio": 0.05, "sep_mas": 110.0, "pa_deg": 200.0}},
    "pupil 20 cm off": {"pupil_misregistration": {"dx_m": 0.2, "dy_m": 0.0, "rotation_deg": 0.0}},
    "non-linearity 30 %": {"detector_nonlinearity": {"fraction_at_peak": 0.3}},
    "vibration 15 mas": {"vibration": {"sigma_mas": 15.0, "angle_deg": 30.0}},
    "low wind": {"low_wind_effect": {"piston_nm": [90.0, -60.0, 40.0, -70.0]}},
}
RAMP_TOLD: dict[str, dict[str, Any]] = {
    "offsets of wrong sign": {"offsets": -1.0},
    "offsets × 2": {"offsets": 2.0},
    "offsets × 0.7": {"offsets": 0.7},
    "offsets in micrometres": {"offsets": 1e-3},
    "diversity of wrong sign in the ramp": {"diversity": -1.0},
    "diversity of wrong sign in ramp and cube": {"diversity": -1.0, "both": True},
    "diversity halved in the ramp": {"diversity": 0.5},
    "wavelength 10 % off in the ramp": {"wavelength": 1.1},
}
RAMP_SEEN = ("flipped left to right", "flipped up and down", "turned by 180°", "transposed")
RAMP_HIDDEN = {
    "companion 30 %": {"companion": {"flux_ratio": 0.3, "sep_mas": 190.0, "pa_deg": 40.0}},
    "calibration of another instrument": {},
}
# Right recordings: changes of the usual one.
RIGHTS: dict[str, dict[str, Any]] = {
    "as usual": {},
    "faint": {"mag_j": 11.5},
    "bright": {"mag_j": 6.8},
    "poor seeing": {"seeing_arcsec": 1.2},
    "good seeing": {"seeing_arcsec": 0.35},
    "few frames": {"frames": 10},
    "many frames": {"frames": 120},
    "odd window": {"window": (43, 56)},
    "long exposures": {"exposure_s": 0.3},
    "residual along the wind": {"shape": "servo_lag"},
}
DIAGNOSED = ("companion 5 %", "low wind", "pupil 20 cm off")


@dataclass(frozen=True)
class Case:
    """One recording, or one ramp with its calibration.

    Attributes
    ----------
    kind : str
        `CALIBRATION`, `RAMP` or `DIAGNOSIS`.
    family : str
        What is wrong, or `RIGHT` and how.
    setting : str
        `BENCH` or `SKY`.
    usual, told, hidden : mapping
        Changes of the simulation, of the side-car, and effects nobody told.
    seen : str
        What is done to the images.
    number, suite_seed : int
        Draw of the family, and of all.
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
    """Return every case, `draws` of each family and setting; two of three draws of right ones are more."""
    cases = [case for number in range(draws) for case in _draw(suite_seed, number)]
    more = range(draws, 3 * draws)
    return cases + [case for number in more for case in _draw(suite_seed, number) if case.right]


def _draw(suite_seed: int, number: int) -> Iterator[Case]:
    for setting in (SKY, BENCH):
        for name, usual in RIGHTS.items():
            if setting == SKY or not {"seeing_arcsec", "shape"} & set(usual):
                yield Case(CALIBRATION, f"{RIGHT}: {name}", setting, number, suite_seed, usual)
        for name, told in TOLD.items():
            yield Case(CALIBRATION, name, setting, number, suite_seed, told=told)
        for name in SEEN:
            yield Case(CALIBRATION, name, setting, number, suite_seed, seen=name)
        for name, hidden in HIDDEN.items():
            yield Case(CALIBRATION, name, setting, number, suite_seed, hidden=hidden)
        yield Case(RAMP, f"{RIGHT}: ramp", setting, number, suite_seed)
        for name, told in RAMP_TOLD.items():
            yield Case(RAMP, name, setting, number, suite_seed, told=told)
        for name in RAMP_SEEN:
            yield Case(RAMP, name, setting, number, suite_seed, seen=name)
        for name, hidden in RAMP_HIDDEN.items():
            yield Case(RAMP, name, setting, number, suite_seed, hidden=hidden)
        yield Case(DIAGNOSIS, f"{RIGHT}: nothing hidden", setting, number, suite_seed)
        for name in DIAGNOSED:
            yield Case(DIAGNOSIS, name, setting, number, suite_seed, hidden=HIDDEN[name])
