"""The profile of an instrument that has none: from a pupil by name, numbers or samples, and a few facts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.instrument.instrument import PROFILES
from irlos_pipe.instrument.profile import FACTS
from irlos_pipe.instrument.pupil import PupilSection

CIRCLE = "circle"
TELESCOPES = {"vlt": "irlos", "palomar": "pharo", "keck": "nirc2_narrow"}  # names of pupils: the profile
CORRECTED_CYCLES = 20.0  # per diameter, of adaptive optics of which nothing is declared: as of the VLT
SIZES = ("diameter_m", "obscuration", "obscuration_m", "vanes", "map", "metres_per_sample")
ORIGIN = {"status": "adopted", "source": "declared with the images"}
MAP_FILE = "pupil_map.fits"


def made_profile(
    pupil: str | Mapping[str, Any] | np.ndarray, facts: Mapping[str, Any]
) -> tuple[dict[str, Any], np.ndarray | None]:
    """Return the content of a profile, and the amplitude map that it expects beside it as `MAP_FILE`.

    Parameters
    ----------
    pupil : str, mapping or ndarray
        The name of a telescope, or ``circle``; numbers: ``diameter_m``, ``obscuration`` (of the diameter) or
        ``obscuration_m``, ``vanes`` ``{"angles_deg": [...], "width_m": ...}``, and the keys of the section
        `pupil` of a profile; or an amplitude map (rows, columns), whose sides are the diameter.
    facts : mapping
        Facts of a profile by name, among them ``pupil_diameter_m`` where `pupil` does not state it.

    Raises
    ------
    ConfigurationError
        For unknown names and keys, and numbers that are missing. What they mean is checked with the profile.
    """
    bench, vlt = (load_yaml(PROFILES / f"{name}.yaml")[0] for name in ("bench", "irlos"))
    known = {name: fact for name, fact in vlt["facts"].items() if name in FACTS and "pupil" not in name}
    own: dict[str, Any] = dict(facts)
    section, samples = None, None
    if isinstance(pupil, str) and pupil != CIRCLE:
        name = TELESCOPES.get(pupil, pupil)
        names = sorted(path.stem for path in PROFILES.glob("*.yaml"))
        if name not in names:
            raise ConfigurationError(
                f"unknown pupil '{pupil}'{suggestion(pupil, [CIRCLE, *TELESCOPES, *names])}"
            )
        if "pupil_diameter_m" in own:
            raise ConfigurationError(f"pupil '{pupil}' has its diameter; leave diameter_m out")
        profile = load_yaml(PROFILES / f"{name}.yaml")[0]
        known = {fact: value for fact, value in profile["facts"].items() if fact in FACTS}
        section = profile.get("pupil")
    else:
        numbers = dict(pupil) if isinstance(pupil, Mapping) else {}
        if not isinstance(pupil, (str, Mapping)):
            numbers["map"] = pupil
        section, samples = _drawn(numbers, own)
        cutoff_per_m = CORRECTED_CYCLES / own["pupil_diameter_m"] if own["pupil_diameter_m"] else math.nan
        known["ao_cutoff_per_m"] = {"value": cutoff_per_m, "unit": "1/m"} | ORIGIN
    declared = {name: {"value": value, "unit": FACTS[name].unit} | ORIGIN for name, value in own.items()}
    profile = bench | {"name": "as declared", "title": "", "facts": bench["facts"] | known | declared}
    return profile | ({"pupil": ORIGIN | section} if section else {}), samples


def _drawn(numbers: dict[str, Any], facts: dict[str, Any]) -> tuple[dict[str, Any], np.ndarray | None]:
    """The section `pupil` of a profile, and its map; the sizes go to the `facts`."""
    allowed = (*SIZES, *(key for key in PupilSection.model_fields if key not in ORIGIN))
    for key in numbers:
        if key not in allowed:
            raise ConfigurationError(f"pupil: unknown key '{key}'{suggestion(key, allowed)}")
    diameter_m = numbers.pop("diameter_m", facts.get("pupil_diameter_m"))
    for name, value in {"diameter_m": diameter_m, "obscuration": numbers.get("obscuration", 0.0)}.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            shown = "is missing" if value is None else f"= {value!r} should be a number"
            raise ConfigurationError(
                f"pupil: {name} {shown}; for example diameter_m = 8.0, obscuration = 0.14"
            )
    facts["pupil_diameter_m"] = diameter_m
    facts["pupil_obscuration_m"] = numbers.pop("obscuration_m", numbers.pop("obscuration", 0.0) * diameter_m)
    vanes, step_m = numbers.get("vanes", ()), numbers.pop("metres_per_sample", None)
    samples = _numbers("map", numbers["map"]) if "map" in numbers else None
    if samples is not None:
        step_m = step_m or diameter_m / max(*samples.shape, 1, 1)
        numbers["map"] = {"file": MAP_FILE, "metres_per_sample": step_m}
    if isinstance(vanes, Mapping):
        if set(vanes) != {"angles_deg", "width_m"}:
            known = "{'angles_deg': [...], 'width_m': ...}"
            raise ConfigurationError(f"pupil: vanes are {known}, or one by one as in a profile")
        rim_m = 0.525 * diameter_m
        numbers["vanes"] = [
            {
                "start_m": [0, 0],
                "end_m": [rim_m * math.cos(angle), rim_m * math.sin(angle)],
                "width_m": vanes["width_m"],
            }
            for angle in np.radians(_numbers("vanes: angles_deg", vanes["angles_deg"]).ravel())
        ]
    return numbers, samples


def _numbers(name: str, values: Any) -> np.ndarray:
    """Values as an array of float64."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        raise ConfigurationError(f"pupil: {name} should be numbers") from None
