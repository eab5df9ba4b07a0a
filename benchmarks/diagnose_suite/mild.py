"""Mild errors of everything at once: the instrument as it is, of which the diagnosis is told the nominal one.

Sizes are those of the limits below, in every recording; signs, directions, places and patterns are random.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.diagnose_suite.hidden import second_image_place
from benchmarks.diagnose_suite.settings import NARROW, Setting
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.light import mean_centre_nm
from irlos_pipe.simulate.recordings.spec import BANDS

OBSCURATION = 0.10  # of its diameter
VANES_DEG = 3.0
STOP_M = 0.05
PLATE_SCALE = 0.005
BAND_NM = 5.0
TAIL_NM, TAIL_NOLLS = 2.0, (52, 200)
FLAT = 0.005  # RMS
GHOST = 0.003  # of the star's light
GHOST_DEFOCUS_NM = 100.0
# Of the AO residual, inside the correction band; the model expects a power law of free slope, and the
# simulator's default is a slope of 2.
LAWS: tuple[Mapping[str, Any], ...] = (
    {"shape": "power_law", "slope": 1.0},
    {"shape": "power_law", "slope": 3.0},
    {"shape": "servo_lag"},
    {"shape": "aliasing"},
)
OUTER_SCALES = (0.5, 2.0)  # of the profile's
ALIKE_IN_NARROW_BAND = frozenset({"plate_scale", "spectrum"})  # both only scale the image


@dataclass(frozen=True)
class Mild:
    """The mild errors of one case; without arguments there are none.

    Attributes
    ----------
    sections : mapping
        Keys of a simulation spec, by section.
    effects : mapping
        Effects of the catalogue in every recording, with the simulator's parameters.
    """

    sections: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    effects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def over(self, sections: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Return the `sections` of a spec with the errors."""
        changed = {name: {**sections.get(name, {}), **own} for name, own in self.sections.items()}
        shared = {"effects": {name: dict(own) for name, own in self.effects.items()}} if self.effects else {}
        return dict(sections) | changed | shared

    def without(self, hidden: Mapping[str, Mapping[str, Any]], setting: Setting) -> Mild:
        """Return the errors that remain beside what is hidden.

        What is hidden takes the place of an error of the same parameter, and of one that has the same image:
        two of them would add up or cancel.

        Parameters
        ----------
        hidden : mapping
            Effects with the simulator's parameters.
        setting : Setting
        """
        alike = ALIKE_IN_NARROW_BAND if setting.bands == NARROW and ALIKE_IN_NARROW_BAND & set(hidden) else ()
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


def drawn_mild(setting: Setting, rng: np.random.Generator) -> Mild:
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


def _signed(size: float, rng: np.random.Generator) -> float:
    return float(size * rng.choice([-1.0, 1.0]))
