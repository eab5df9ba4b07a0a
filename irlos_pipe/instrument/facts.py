"""The facts that a profile may state: names, units, limits, and what contradicts what."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from irlos_pipe.conventions.text import suggestion
from irlos_pipe.instrument.units import require_unit, unit_of_name

MOST_CYCLES = 500  # per diameter that adaptive optics may correct: a thousand actuators across


class Dated(Protocol):
    """A value with its unit and the days on which it held, as ISO dates."""

    @property
    def value(self) -> Any:
        """The value itself."""

    @property
    def unit(self) -> str:
        """Its unit as text."""

    @property
    def since(self) -> str | None:
        """First day on which it held."""

    @property
    def until(self) -> str | None:
        """First day on which it no longer held."""


@dataclass(frozen=True)
class FactRule:
    """What a fact has to be.

    Attributes
    ----------
    unit, text : str
        What it is, for the documentation.
    low, high : float
        Limits of a number, or of every number in a list.
    required : bool
    kind : {"number", "vanes", "lines", "sky"}
        A number; a list of vanes [[x, y], [x, y]]; of vibrations [Hz, share_x, share_y]; of bands [nm, mag].
    """

    unit: str
    text: str
    low: float
    high: float
    required: bool = True
    kind: Literal["number", "vanes", "lines", "sky"] = "number"


FACTS: dict[str, FactRule] = {
    "pupil_diameter_m": FactRule(
        "m", "disc that contains the pupil; Zernikes have unit RMS on it", 1e-4, 100
    ),
    "pupil_obscuration_m": FactRule("m", "round hole about the axis", 0, 100, False),
    "pupil_vanes_m": FactRule("m", "vanes of one width, [[x, y], [x, y]] each", -200, 200, False, "vanes"),
    "pupil_vane_width_m": FactRule("m", "their width", 0, 10, False),
    "focus_numerical_aperture": FactRule("1", "NA / n at which defocus is introduced", 0, 1, False),
    "photons_per_s_m15": FactRule("1/s", "through aperture and sensor band at m_J = 15", 1e-6, 1e12),
    "ao_cutoff_per_m": FactRule("1/m", "end of the AO correction, 1/(2 actuator pitch)", 1e-3, 1e6),
    "outer_scale_m": FactRule("m", "of the turbulence", 1, 1000),
    "ao_residual_nm_per_arcsec": FactRule("nm/arcsec", "slope of the AO residual against seeing", 0, 1e4),
    "ao_residual_floor_nm": FactRule("nm", "AO residual at zero seeing", 0, 1e4),
    "ncpa_amplitude_nm": FactRule("nm", "std of Noll i+2 = amplitude exp(-decay i) + plateau", 0, 1e4),
    "ncpa_decay": FactRule("1", "see ncpa_amplitude_nm", 0, 100),
    "ncpa_plateau_nm": FactRule("nm", "see ncpa_amplitude_nm", 0, 1e4),
    "seeing_arcsec": FactRule("arcsec", "where none was measured", 0.01, 10),
    "vibration_lines": FactRule(
        "Hz, 1, 1", "[Hz, share of the variance along x, along y]", 0, 1e5, False, "lines"
    ),
    "sky_mag_per_arcsec2": FactRule(
        "nm, mag/arcsec2", "brightness of the sky in each band, [wavelength, mag]", -10, 1e6, False, "sky"
    ),
    "amplifier_e_per_adu": FactRule("e-/ADU", "gain behind the avalanche, for `modes`", 1e-9, 1e6, False),
}
# Facts that defaults, modes and seeing scales choose among; any other name must be used by one of them.
FAMILIES = (
    r"(site|pixel_scale|apd_gain|read_noise|read_exposure|dark_current|excess_noise|recorder|seeing_ratio|"
    r"seeing_offset)_\w+"
)
# Keys of the side-car that a profile may give.
DEFAULTS = (
    "pixel_scale_mas",
    "frame_rate_hz",
    "exposure_s",
    "seeing_arcsec",
    "pressure_hpa",
    "temperature_c",
    "humidity_percent",
    "detector.e_per_adu",
    "detector.read_noise_e",
    "detector.excess_noise_factor",
    "detector.saturation_adu",
    "detector.read_s",
    "detector.dark_e_per_s",
)


def require_facts(facts: Mapping[str, Sequence[Dated]], used: Iterable[str], *, modes: bool) -> None:
    """Check the facts of a profile.

    Parameters
    ----------
    facts : mapping of str to sequence
        Values that held one after the other.
    used : iterable of str
        Names to which other sections refer.
    modes : bool
        Whether there are read-out modes, which need the amplifier's gain.

    Raises
    ------
    ValueError
        Naming the fact and what it should be.
    """
    needed = [name for name, rule in FACTS.items() if rule.required]
    for name in [*needed, *(["amplifier_e_per_adu"] if modes else [])]:
        if name not in facts:
            raise ValueError(f"fact '{name}' is missing ({FACTS[name].text}); docs/instruments.md lists all")
    known = {*FACTS, *used}
    for name, entries in facts.items():
        if name not in known and not re.fullmatch(FAMILIES, name):
            raise ValueError(f"unknown fact '{name}'{suggestion(name, FACTS)}")
        for entry in entries:
            _require_dates(name, entry)
            unit = FACTS[name].unit if name in FACTS else unit_of_name(name)
            if unit is not None:
                require_unit(name, entry.unit, unit)
            if name in FACTS:
                _require_value(name, FACTS[name], entry.value)
    if ("pupil_vanes_m" in facts) != ("pupil_vane_width_m" in facts):
        raise ValueError("facts 'pupil_vanes_m' and 'pupil_vane_width_m' belong together; give both or none")
    _require_correction(facts)


def require_used_units(
    facts: Mapping[str, Sequence[Dated]], uses: Iterable[tuple[str, str, str | None]]
) -> None:
    """Check that facts have the unit of what they stand in for.

    Parameters
    ----------
    facts : mapping of str to sequence
        See `require_facts`.
    uses : iterable of (str, str, str or None)
        Key, name of the fact that gives it, and its unit, if it has one.

    Raises
    ------
    ValueError
        Naming key, fact and both units.
    """
    for key, name, unit in uses:
        for entry in facts.get(name, ()) if unit is not None else ():
            try:
                require_unit(name, entry.unit, str(unit))
            except ValueError as problem:
                raise ValueError(f"{key}: {problem}") from None


def _require_dates(name: str, entry: Dated) -> None:
    if entry.since and entry.until and entry.since >= entry.until:
        raise ValueError(f"fact '{name}': since {entry.since} is not before until {entry.until}")


def _require_value(name: str, rule: FactRule, value: Any) -> None:
    shapes = {
        "number": (_is_number, f"a number from {rule.low:g} to {rule.high:g}"),
        "vanes": (_is_vane, "a list of [[x, y], [x, y]] in metres"),
        "lines": (_is_line, "a list of [Hz, share_x, share_y]"),
        "sky": (_is_point, "a list of [wavelength in nm, mag]"),
    }
    fits, text = shapes[rule.kind]
    several = value if rule.kind != "number" else [value]
    if not isinstance(several, list) or not all(fits(one) for one in several):
        shown = f" = {value!r}" if rule.kind == "number" else ""
        raise ValueError(f"fact '{name}'{shown} should be {text}")
    if rule.kind == "number" and not rule.low <= value <= rule.high:
        raise ValueError(f"fact '{name}' = {value!r} should be {text}")
    if rule.kind == "lines" and any(sum(line[axis] for line in several) > 1 for axis in (1, 2)):
        raise ValueError(f"fact '{name}': the shares of one axis add up to more than 1")


def _require_correction(facts: Mapping[str, Sequence[Dated]]) -> None:
    """A cut-off below 1/D corrects nothing; one beyond a thousand actuators is a mistake of units."""
    for diameter in facts["pupil_diameter_m"]:
        for cutoff in facts["ao_cutoff_per_m"]:
            cycles = cutoff.value * diameter.value
            if not 1 < cycles <= MOST_CYCLES:
                raise ValueError(
                    f"fact 'ao_cutoff_per_m' = {cutoff.value:g} is {cycles:g} cycles per pupil diameter; "
                    f"it should be 1/(2 actuator pitch), between 1 and {MOST_CYCLES} of them"
                )


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_line(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_is_number, value)) and min(value) >= 0


def _is_vane(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_point, value))


def _is_point(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))
