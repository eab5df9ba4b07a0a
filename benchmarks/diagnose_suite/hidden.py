"""What is hidden: effects of the catalogue, drawn at a size; and mild errors of everything else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.cases import EXPOSURE_S, NARROW, Setting
from irlos_pipe.conventions.bands import NARROW_H
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.effects.sky import JITTER_CORRELATION_S
from irlos_pipe.simulate.light import mean_centre_nm
from irlos_pipe.simulate.recordings.spec import BANDS

SPREAD = 0.25  # largest deviation of a drawn size from its level, natural logarithm
LINES_HZ = (24.2, 45.5, 48.3, 72.5)  # vibrations of UT4 above 20 Hz
PIXEL_SCALE_MAS = 9.7
# Parameters that say how large an effect is, where its others do not: places, directions, frequencies.
SIZED_BY = {
    "atmospheric_dispersion": "mas_per_um",
    "anamorphism": "fraction",
    "phase_bump": "nm",
    "pupil_spot": "opacity",
    "companion": "flux_ratio",
    "ghost": "flux_ratio",
    "background_gradient": "e_per_pixel",
    "bad_pixels": "pixels",
}

Rng = np.random.Generator
Parameters = dict[str, Any]


@dataclass(frozen=True)
class Hidden:
    """One effect as it is in a recording."""

    effect: str
    parameters: Mapping[str, Any]  # parameters of the simulator
    truth: Mapping[str, Any]  # under the public names of the catalogue, those that say how large it is

    @property
    def known(self) -> dict[str, Any]:
        """What a recipe's model would state of it."""
        public = {one.name for one in CATALOGUE[self.effect].public}
        return {key: value for key, value in {**self.parameters, **self.truth}.items() if key in public}


def drawn(effect: str, level_size: float, setting: Setting, rng: Rng) -> Hidden:
    """An effect about as large as its level, in a random place or direction."""
    size = float(level_size * np.exp(SPREAD * rng.uniform(-1, 1)))
    parameters = DRAWS[effect](rng, size, setting)
    truth = {SIZED_BY[effect]: parameters[SIZED_BY[effect]]} if effect in SIZED_BY else parameters
    # A frame's mean position moves, too, which blurs the mean of the frames.
    if effect == "tip_tilt_jitter":
        truth = {"sigma_mas": float(size * np.sqrt(1 + JITTER_CORRELATION_S / EXPOSURE_S))}
    if effect == "vibration":
        line = np.sinc(parameters["frequency_hz"] * EXPOSURE_S)
        truth = {"sigma_mas": float(size * np.sqrt(1 + line**2))}
    return Hidden(effect, parameters, truth)


def _plain(key: str, signed: bool = False) -> Callable[[Rng, float, Setting], Parameters]:
    return lambda rng, size, setting: {key: float(size * (_sign(rng) if signed else 1.0))}


def _modes(key: str, nolls: range | None, how_many: int) -> Callable[[Rng, float, Setting], Parameters]:
    """Some modes of a given RMS each; of the setting, where no `nolls` are given."""

    def draw(rng: Rng, size: float, setting: Setting) -> Parameters:
        among = setting.hidden_nolls if nolls is None else nolls
        taken = sorted(rng.choice(among, how_many, replace=False).tolist())
        values = rng.standard_normal(how_many)
        values_of_rms = (values * size / np.sqrt(np.mean(values**2))).tolist()
        return {key: dict(zip(taken, values_of_rms, strict=True))}

    return draw


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _signed(size: float, rng: Rng) -> float:
    return float(size * rng.choice([-1.0, 1.0]))


def _angle_deg(rng: Rng, turn_deg: float = 360.0) -> float:
    return float(rng.uniform(0, turn_deg))


def _place(rng: Rng) -> dict[str, float]:
    """Somewhere between the hole and the rim of the pupil."""
    radius, angle = rng.uniform(1.2, 3.0), rng.uniform(0, 2 * np.pi)
    return {"x_m": float(radius * np.cos(angle)), "y_m": float(radius * np.sin(angle))}


def second_image_place(rng: Rng, setting: Setting) -> dict[str, float]:
    """Place beyond λ/D and within the window."""
    farthest = 0.42 * setting.window * PIXEL_SCALE_MAS
    return {"sep_mas": float(rng.uniform(60, farthest)), "pa_deg": _angle_deg(rng)}


def _vibration(rng: Rng, size: float, setting: Setting) -> Parameters:
    hz, angle = float(rng.choice(LINES_HZ)), _angle_deg(rng, 180)
    return {"sigma_mas": size, "angle_deg": angle, "frequency_hz": hz}


def _spectrum(rng: Rng, size: float, setting: Setting) -> Parameters:
    """The filter's centre in a narrow band, the colour of the star between J and H."""
    value = size * _sign(rng)
    return {"slope": value} if setting.bands == "j_h" else {"wavelength_nm": NARROW_H.centre_nm + value}


def _pupil(rng: Rng, size: float, setting: Setting) -> Parameters:
    """The stop displaced, and the vanes turned by as much at half the radius."""
    angle = rng.uniform(0, 2 * np.pi)
    turned = float(np.rad2deg(size / 2.0)) * _sign(rng)
    return {"dx_m": float(size * np.cos(angle)), "dy_m": float(size * np.sin(angle)), "rotation_deg": turned}


def _hole(rng: Rng, size: float, setting: Setting) -> Parameters:
    nominal_m = load_instrument("irlos").facility.pupil.obscuration_m
    return {"obscuration_m": nominal_m + size * _sign(rng)}


def _low_wind(rng: Rng, size: float, setting: Setting) -> Parameters:
    """Without mean piston, tip and tilt, which belong to the whole pupil."""
    petals = size * rng.standard_normal((3, 4)) * np.array([[1.0], [0.4], [0.4]])
    petals -= petals.mean(axis=1, keepdims=True)
    return dict(zip(("piston_nm", "tip_nm", "tilt_nm"), petals.tolist(), strict=True))


def _ghost(rng: Rng, size: float, setting: Setting) -> Parameters:
    """Out of focus by as much as distinguishes it from a companion."""
    defocus_nm = float(rng.uniform(50, 200)) * _sign(rng)
    return {"flux_ratio": size, **second_image_place(rng, setting), "defocus_nm": defocus_nm}


def _bad_pixels(rng: Rng, size: float, setting: Setting) -> Parameters:
    """One to four, of one kind: hot anywhere; dead or stuck where there is light."""
    kind = str(rng.choice(["hot", "dead", "stuck"]))
    reach = setting.window // 2 - 4 if kind == "hot" else 3
    pixels = setting.window // 2 + rng.integers(-reach, reach, (int(rng.integers(1, 5)), 2))
    unique = sorted({(int(row), int(column)) for row, column in pixels})
    return {"pixels": [list(pixel) for pixel in unique], "kind": kind, "level_e": size}


# Parameters of the simulator by the random numbers, the size and the setting.
DRAWS: dict[str, Callable[[Rng, float, Setting], Parameters]] = {
    "tip_tilt_jitter": lambda rng, size, setting: {"sigma_mas": size},
    "vibration": _vibration,
    "seeing_halo": _plain("wfe_nm"),
    "atmospheric_dispersion": lambda rng, size, setting: {"mas_per_um": size, "angle_deg": _angle_deg(rng)},
    "spectrum": _spectrum,
    "plate_scale": _plain("fraction", signed=True),
    "anamorphism": lambda rng, size, setting: {"fraction": size, "angle_deg": _angle_deg(rng, 180)},
    "diversity_error": _plain("nm", signed=True),
    "pupil_misregistration": _pupil,
    "pupil_geometry": _hole,
    "amplitude_aberration": _modes("zernike", range(2, 12), 4),
    "low_wind_effect": _low_wind,
    "high_order_ncpa": _modes("zernike_nm", None, 4),
    "phase_bump": lambda rng, size, setting: {
        "nm": size * _sign(rng),
        **_place(rng),
        "width_m": float(rng.uniform(0.3, 0.6)),
    },
    "pupil_spot": lambda rng, size, setting: {
        "opacity": size,
        **_place(rng),
        "radius_m": float(rng.uniform(0.3, 0.6)),
    },
    "ncpa_drift": _modes("zernike_nm", range(4, 12), 3),
    # Of tip and tilt nothing, which are dispersion.
    "chromatic_ncpa": _modes("zernike_nm_per_um", range(4, 16), 4),
    "filter_ncpa": _modes("zernike_nm", range(5, 16), 4),
    "companion": lambda rng, size, setting: {"flux_ratio": size, **second_image_place(rng, setting)},
    "ghost": _ghost,
    "interpixel_crosstalk": _plain("fraction"),
    "detector_nonlinearity": _plain("fraction_at_peak"),
    "background_gradient": lambda rng, size, setting: {"e_per_pixel": size, "angle_deg": _angle_deg(rng)},
    "bad_pixels": _bad_pixels,
    "focus_stage_hysteresis": _plain("nm", signed=True),
    "focus_stage_offset": _plain("nm", signed=True),
    "focus_stage_scale": _plain("fraction", signed=True),
}


# -- mild errors -------------------------------------------------------------------------------
#
# The instrument as it is, of which the diagnosis is given the nominal one. Every recording has errors of
# these sizes; signs, directions, places and patterns are random.

OBSCURATION = 0.10  # relative error of the diameter
VANES_DEG = 3.0
STOP_M = 0.05
PLATE_SCALE = 0.005  # relative
BAND_NM = 5.0  # error of the wavelengths
TAIL_NM, TAIL_NOLLS = 2.0, (52, 200)
FLAT = 0.005  # RMS error of the flat
GHOST = 0.003  # part of the star's light
GHOST_DEFOCUS_NM = 100.0
# Of the AO residual, inside the correction band; the model expects a power law of free slope, and the
# simulator's default is a slope of 2.
LAWS: tuple[Mapping[str, Any], ...] = (
    {"shape": "power_law", "slope": 1.0},
    {"shape": "power_law", "slope": 3.0},
    {"shape": "servo_lag"},
    {"shape": "aliasing"},
)
OUTER_SCALES = (0.5, 2.0)  # range, in units of the profile's
DEGENERATE_IN_NARROW_BAND = frozenset({"plate_scale", "spectrum"})  # both only scale the image


@dataclass(frozen=True)
class Mild:
    """The mild errors of one case; without arguments there are none."""

    # Keys of a simulation spec, by section.
    sections: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    # Effects of the catalogue in every recording, with the simulator's parameters.
    effects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def over(self, sections: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Return the `sections` of a spec with the errors."""
        changed = {name: {**sections.get(name, {}), **own} for name, own in self.sections.items()}
        shared = {"effects": {name: dict(own) for name, own in self.effects.items()}} if self.effects else {}
        return dict(sections) | changed | shared

    def without(self, hidden: Mapping[str, Mapping[str, Any]], setting: Setting) -> Mild:
        """Return the errors that remain besides what is `hidden`, effects with the simulator's parameters.

        What is hidden takes the place of an error of the same parameter, and of one that has the same image:
        two of them would add up or cancel.
        """
        alike = (
            DEGENERATE_IN_NARROW_BAND
            if setting.bands == NARROW and DEGENERATE_IN_NARROW_BAND & set(hidden)
            else ()
        )
        rest = {
            name: {key: value for key, value in own.items() if key not in hidden.get(name, {})}
            for name, own in self.effects.items()
            if name not in alike
        }
        return replace(self, effects={name: own for name, own in rest.items() if own})

    @property
    def truth(self) -> dict[str, Mapping[str, Any]]:
        """What is there, under the names that a diagnosis may rightly give it; `flat_error` has none."""
        named = {
            "pupil_geometry": self.sections.get("pupil"),
            "high_order_ncpa": self.sections.get("ncpa"),
            "seeing_halo": self.sections.get("sky"),
            "flat_error": self.sections.get("detector"),
        }
        return {**self.effects, **{name: dict(value) for name, value in named.items() if value}}


def drawn_mild(setting: Setting, rng: Rng) -> Mild:
    """Draw the errors of a case; on the bench there is no AO residual."""
    facility = load_instrument("irlos").facility
    angle = rng.uniform(0, 2 * np.pi)
    effects = {
        "plate_scale": {"fraction": _signed(PLATE_SCALE, rng)},
        "spectrum": {"wavelength_nm": mean_centre_nm(BANDS[setting.bands]) + _signed(BAND_NM, rng)},
        "pupil_misregistration": {
            "dx_m": float(STOP_M * np.cos(angle)),
            "dy_m": float(STOP_M * np.sin(angle)),
            "rotation_deg": _signed(VANES_DEG, rng),
        },
        "ghost": {
            "flux_ratio": GHOST,
            **second_image_place(rng, setting),
            "defocus_nm": _signed(GHOST_DEFOCUS_NM, rng),
        },
    }
    sections = {
        "pupil": {"obscuration_m": facility.pupil.obscuration_m * (1 + _signed(OBSCURATION, rng))},
        "ncpa": {"tail_nm": TAIL_NM, "tail_nolls": list(TAIL_NOLLS)},
        "detector": {"flat_error_rms": FLAT, "pattern_seed": int(rng.integers(2**31))},
    }
    law = dict(LAWS[rng.integers(len(LAWS))])
    outer_scale_m = facility.outer_scale_m * float(rng.choice(OUTER_SCALES))
    if setting.on_sky:
        sections["sky"] = {**law, "outer_scale_m": outer_scale_m}
    return Mild(sections, effects)
