"""What is hidden: the effects of the catalogue, drawn at a size, and what is true about them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.settings import EXPOSURE_S, Setting
from irlos_pipe.conventions.bands import NARROW_H
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.effects.sky import JITTER_CORRELATION_S

SPREAD = 0.25  # of the drawn size about its level, natural logarithm
LINES_HZ = (24.2, 45.5, 48.3, 72.5)  # of UT4 above 20 Hz
PIXEL_SCALE_MAS = 9.7


@dataclass(frozen=True)
class Hidden:
    """One effect as it is in a recording.

    Attributes
    ----------
    effect : str
    parameters : mapping
        Of the simulator.
    truth : mapping
        Under the public names of the catalogue, those that say how large it is.
    """

    effect: str
    parameters: Mapping[str, Any]
    truth: Mapping[str, Any]

    @property
    def known(self) -> dict[str, Any]:
        """What a recipe's model would state of it."""
        public = {one.name for one in CATALOGUE[self.effect].public}
        return {key: value for key, value in {**self.parameters, **self.truth}.items() if key in public}


Draw = Callable[[np.random.Generator, float, Setting], Hidden]


def drawn(effect: str, level_size: float, setting: Setting, rng: np.random.Generator) -> Hidden:
    """An effect about as large as its level, in a random place or direction."""
    size = float(level_size * np.exp(SPREAD * rng.uniform(-1, 1)))
    return DRAWS[effect](rng, size, setting)


def _plain(effect: str, key: str, signed: bool = False) -> Draw:
    def draw(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
        value = {key: float(size * (_sign(rng) if signed else 1.0))}
        return Hidden(effect, value, value)

    return draw


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _angle_deg(rng: np.random.Generator, turn_deg: float = 360.0) -> float:
    return float(rng.uniform(0, turn_deg))


def _table(rng: np.random.Generator, size: float, nolls: range, how_many: int) -> dict[int, float]:
    """Some modes of a given RMS each."""
    chosen = sorted(rng.choice(nolls, how_many, replace=False).tolist())
    values = rng.standard_normal(how_many)
    return dict(zip(chosen, (values * size / np.sqrt(np.mean(values**2))).tolist(), strict=True))


def _jitter(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    """A frame's mean position moves too, which blurs the mean of the frames."""
    frame_mean = np.sqrt(1 + JITTER_CORRELATION_S / EXPOSURE_S)
    return Hidden("tip_tilt_jitter", {"sigma_mas": size}, {"sigma_mas": float(size * frame_mean)})


def _vibration(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    hz, angle = float(rng.choice(LINES_HZ)), _angle_deg(rng, 180)
    total = float(size * np.sqrt(1 + np.sinc(hz * EXPOSURE_S) ** 2))
    line = {"sigma_mas": size, "angle_deg": angle, "frequency_hz": hz}
    return Hidden("vibration", line, {"sigma_mas": total})


def _dispersion(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    values = {"mas_per_um": size, "angle_deg": _angle_deg(rng)}
    return Hidden("atmospheric_dispersion", values, {"mas_per_um": size})


def _spectrum(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    """The filter's centre in a narrow band, the colour of the star between J and H."""
    value = size * _sign(rng)
    if setting.bands == "j_h":
        return Hidden("spectrum", {"slope": value}, {"slope": value})
    centre = {"wavelength_nm": NARROW_H.centre_nm + value}
    return Hidden("spectrum", centre, centre)


def _anamorphism(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    stretch = {"fraction": size, "angle_deg": _angle_deg(rng, 180)}
    return Hidden("anamorphism", stretch, {"fraction": size})


def _pupil(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    """The stop displaced, and the vanes turned by as much at half the radius."""
    angle = rng.uniform(0, 2 * np.pi)
    turned = float(np.rad2deg(size / 2.0)) * _sign(rng)
    shift = {"dx_m": float(size * np.cos(angle)), "dy_m": float(size * np.sin(angle)), "rotation_deg": turned}
    return Hidden("pupil_misregistration", shift, shift)


def _sizes(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    """The hole larger or smaller."""
    told_m = load_instrument("irlos").facility.pupil.obscuration_m
    hole = {"obscuration_m": told_m + size * _sign(rng)}
    return Hidden("pupil_geometry", hole, hole)


def _amplitude(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    table = {"zernike": _table(rng, size, range(2, 12), 4)}
    return Hidden("amplitude_aberration", table, table)


def _low_wind(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    """Without mean piston, tip and tilt, which belong to the whole pupil."""
    petals = size * rng.standard_normal((3, 4)) * np.array([[1.0], [0.4], [0.4]])
    petals -= petals.mean(axis=1, keepdims=True)
    table = dict(zip(("piston_nm", "tip_nm", "tilt_nm"), petals.tolist(), strict=True))
    return Hidden("low_wind_effect", table, table)


def _high_order(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    table = {"zernike_nm": _table(rng, size, setting.hidden_nolls, 4)}
    return Hidden("high_order_ncpa", table, table)


def _bump(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    bump = {"nm": size * _sign(rng), **_place(rng), "width_m": float(rng.uniform(0.3, 0.6))}
    return Hidden("phase_bump", bump, {"nm": bump["nm"]})


def _spot(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    spot = {"opacity": size, **_place(rng), "radius_m": float(rng.uniform(0.3, 0.6))}
    return Hidden("pupil_spot", spot, {"opacity": size})


def _place(rng: np.random.Generator) -> dict[str, float]:
    """Somewhere between the hole and the rim of the pupil."""
    radius, angle = rng.uniform(1.2, 3.0), rng.uniform(0, 2 * np.pi)
    return {"x_m": float(radius * np.cos(angle)), "y_m": float(radius * np.sin(angle))}


def _chromatic(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    """Of tip and tilt nothing, which are dispersion."""
    table = {"zernike_nm_per_um": _table(rng, size, range(4, 16), 4)}
    return Hidden("chromatic_ncpa", table, table)


def _filter(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    table = {"zernike_nm": _table(rng, size, range(5, 16), 4)}
    return Hidden("filter_ncpa", table, table)


def _drift(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    table = {"zernike_nm": _table(rng, size, range(4, 12), 3)}
    return Hidden("ncpa_drift", table, table)


def second_image_place(rng: np.random.Generator, setting: Setting) -> dict[str, float]:
    """Place beyond λ/D and within the window."""
    farthest = 0.42 * setting.window * PIXEL_SCALE_MAS
    return {"sep_mas": float(rng.uniform(60, farthest)), "pa_deg": _angle_deg(rng)}


def _companion(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    return Hidden("companion", {"flux_ratio": size, **second_image_place(rng, setting)}, {"flux_ratio": size})


def _ghost(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    """Out of focus by as much as tells it from a companion."""
    defocus_nm = float(rng.uniform(50, 200)) * _sign(rng)
    image = {"flux_ratio": size, **second_image_place(rng, setting), "defocus_nm": defocus_nm}
    return Hidden("ghost", image, {"flux_ratio": size})


def _gradient(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    slope = {"e_per_pixel": size, "angle_deg": _angle_deg(rng)}
    return Hidden("background_gradient", slope, {"e_per_pixel": size})


def _bad_pixels(rng: np.random.Generator, size: float, setting: Setting) -> Hidden:
    """One to four, of one kind: hot anywhere; dead or stuck where there is light."""
    kind = str(rng.choice(["hot", "dead", "stuck"]))
    reach = setting.window // 2 - 4 if kind == "hot" else 3
    pixels = setting.window // 2 + rng.integers(-reach, reach, (int(rng.integers(1, 5)), 2))
    unique = sorted({(int(row), int(column)) for row, column in pixels})
    values = {"pixels": [list(pixel) for pixel in unique], "kind": kind, "level_e": size}
    return Hidden("bad_pixels", values, {"pixels": values["pixels"]})


def _stage(effect: str, key: str = "nm") -> Draw:
    return _plain(effect, key, signed=True)


DRAWS: dict[str, Draw] = {
    "tip_tilt_jitter": _jitter,
    "vibration": _vibration,
    "seeing_halo": _plain("seeing_halo", "wfe_nm"),
    "atmospheric_dispersion": _dispersion,
    "spectrum": _spectrum,
    "plate_scale": _plain("plate_scale", "fraction", signed=True),
    "anamorphism": _anamorphism,
    "diversity_error": _plain("diversity_error", "nm", signed=True),
    "pupil_misregistration": _pupil,
    "pupil_geometry": _sizes,
    "amplitude_aberration": _amplitude,
    "low_wind_effect": _low_wind,
    "high_order_ncpa": _high_order,
    "phase_bump": _bump,
    "pupil_spot": _spot,
    "ncpa_drift": _drift,
    "chromatic_ncpa": _chromatic,
    "filter_ncpa": _filter,
    "companion": _companion,
    "ghost": _ghost,
    "interpixel_crosstalk": _plain("interpixel_crosstalk", "fraction"),
    "detector_nonlinearity": _plain("detector_nonlinearity", "fraction_at_peak"),
    "background_gradient": _gradient,
    "bad_pixels": _bad_pixels,
    "focus_stage_hysteresis": _stage("focus_stage_hysteresis"),
    "focus_stage_offset": _stage("focus_stage_offset"),
    "focus_stage_scale": _stage("focus_stage_scale", "fraction"),
}
STAGE = ("focus_stage_hysteresis", "focus_stage_offset", "focus_stage_scale")
