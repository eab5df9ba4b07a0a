"""The YAML file of an instrument profile: its keys, and the facts that it may state."""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.validation import Section
from irlos_pipe.instrument.pupil import PupilSection, Status, ZenithSection

MOST_CYCLES = 500  # per diameter that adaptive optics may correct: a thousand actuators across


@dataclass(frozen=True)
class FactRule:
    """What a fact has to be: limits are those of a number, or of every number in a list.

    Lists are of vanes [[x, y], [x, y]], of vibrations [Hz, share_x, share_y], or of bands [nm, mag].
    """

    unit: str
    text: str
    low: float
    high: float
    kind: Literal["number", "vanes", "lines", "sky"] = "number"
    required: bool = False


FACTS: dict[str, FactRule] = {
    "pupil_diameter_m": FactRule(
        "m", "disc that contains the pupil; Zernikes have unit RMS on it", 1e-4, 100, required=True
    ),
    "pupil_obscuration_m": FactRule("m", "round hole about the axis", 0, 100),
    "pupil_vanes_m": FactRule("m", "vanes of one width, [[x, y], [x, y]] each", -200, 200, "vanes"),
    "pupil_vane_width_m": FactRule("m", "their width", 0, 10),
    "focus_numerical_aperture": FactRule("1", "NA / n at which defocus is introduced", 0, 1),
    "site_longitude_deg": FactRule(
        "deg", "east of Greenwich; nights end at its noon; Paranal's without it", -360, 360
    ),
    "photons_per_s_m15": FactRule("1/s", "through aperture and sensor band at m_J = 15", 1e-6, 1e12),
    "ao_cutoff_per_m": FactRule("1/m", "end of the AO correction, 1/(2 actuator pitch)", 1e-3, 1e6),
    "outer_scale_m": FactRule("m", "of the turbulence", 1, 1000),
    "ao_residual_nm_per_arcsec": FactRule("nm/arcsec", "slope of the AO residual against seeing", 0, 1e4),
    "ao_residual_floor_nm": FactRule("nm", "AO residual at zero seeing", 0, 1e4),
    "ncpa_amplitude_nm": FactRule(
        "nm", "std of Noll i+2 = amplitude exp(-decay i) + plateau", 0, 1e4, required=True
    ),
    "ncpa_decay": FactRule("1", "see ncpa_amplitude_nm", 0, 100, required=True),
    "ncpa_plateau_nm": FactRule("nm", "see ncpa_amplitude_nm", 0, 1e4, required=True),
    "seeing_arcsec": FactRule("arcsec", "where none was measured", 0.01, 10),
    "vibration_lines": FactRule("Hz, 1, 1", "[Hz, share of the variance along x, along y]", 0, 1e5, "lines"),
    "sky_mag_per_arcsec2": FactRule(
        "nm, mag/arcsec2", "brightness of the sky in each band, [wavelength, mag]", -10, 1e6, "sky"
    ),
    "amplifier_e_per_adu": FactRule("e-/ADU", "gain behind the avalanche, for `modes`", 1e-9, 1e6),
}
# Facts of adaptive optics and seeing, which belong together and ask for the photons; a bench has none.
OF_A_SKY = (
    "ao_cutoff_per_m", "outer_scale_m", "ao_residual_nm_per_arcsec", "ao_residual_floor_nm", "seeing_arcsec",
)  # fmt: skip
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


# What the end of a name says; a longer one comes first.
ENDINGS = {
    "nm_per_arcsec": "nm/arcsec",
    "mag_per_arcsec2": "mag/arcsec2",
    "e_per_adu": "e-/ADU",
    "e_per_s": "e-/s",
    "per_m": "1/m",
    "per_s": "1/s",
    "arcsec": "arcsec",
    "percent": "%",
    "hpa": "hPa",
    "adu": "ADU",
    "mas": "mas",
    "deg": "deg",
    "nm": "nm",
    "hz": "Hz",
    "m": "m",
    "s": "s",
    "e": "e-",
}
OTHER_KEYS = {"temperature_c": "C", "detector.excess_noise_factor": "1"}  # of the side-car
SYNONYMS = {
    "1": ("", "-", "none", "dimensionless", "number", "cycles", "frames", "photons", "photon", "ph"),
    "1/s": ("hz", "s-1", "s^-1", "fps"),
    "1/m": ("m-1", "m^-1"),
    "m": ("metre", "metres", "meter", "meters"),
    "nm": ("nanometre", "nanometres", "nanometer", "nanometers"),
    "mas": ("milliarcsec", "milliarcsecond", "milliarcseconds"),
    "arcsec": ("arcsecond", "arcseconds", '"', "″"),
    "s": ("sec", "second", "seconds"),
    "deg": ("degree", "degrees", "°"),
    "e-": ("e", "e⁻", "electron", "electrons"),
    "adu": ("dn", "count", "counts"),
    "hpa": ("mbar",),
    "c": ("°c", "degc", "celsius"),
    "%": ("percent",),
    "arcsec2": ("arcsec^2", "arcsec²"),
}  # fmt: skip
PLAIN = {spelling: unit for unit, spellings in SYNONYMS.items() for spelling in spellings}
PER_PIXEL = ("px", "pix", "pixel")


def unit_of_name(name: str) -> str | None:
    """Return the unit that a fact or a key of the side-car carries in its `name`; None without one."""
    if name in OTHER_KEYS:
        return OTHER_KEYS[name]
    key = name.rpartition(".")[2]
    return next((unit for end, unit in ENDINGS.items() if key == end or key.endswith(f"_{end}")), None)


def require_unit(name: str, unit: str, wanted: str) -> None:
    """Raise a ValueError that names both where the `unit` of the fact `name` is not the one that is `wanted`.

    Values are not converted: which of the two is the mistake, only the author of the profile knows. Of a unit
    for several columns (``Hz, 1, 1``) the first counts.
    """
    if _plain(unit) != _plain(wanted):
        raise ValueError(
            f"fact '{name}' should be in {wanted}, but its unit is '{unit}'; "
            "convert the value, or correct the unit"
        )


def _plain(unit: str) -> str:
    """The unit in one spelling."""
    first = re.split(r",|\band\b", unit.lower())[0]
    text = re.sub(r"\s+per\s+", "/", f" {first} ").replace(" ", "").removesuffix("rms")
    parts = [PLAIN.get(part, part) for part in PLAIN.get(text, text).split("/") if part not in PER_PIXEL]
    return "/".join(parts)


IsoDate = Annotated[
    str,
    BeforeValidator(lambda value: value.isoformat() if isinstance(value, date) else value),
    Field(pattern=r"^\d{4}-\d\d-\d\d$"),
]


class Fact(Section):
    """One value with its unit, its source, how far to trust it, and when it held."""

    value: Any = Field(description="the value itself")
    unit: str = Field(description="unit as text; '1' for a pure number")
    source: str = Field(min_length=1, description="where the value comes from")
    status: Status
    since: IsoDate | None = Field(None, description="first day on which the value held")
    until: IsoDate | None = Field(None, description="first day on which it no longer held")

    def holds_on(self, day: str | None) -> bool:
        """Return whether the value held on an ISO date `day`; None stands for the present."""
        if day is None:
            return self.until is None
        return (self.since is None or self.since <= day) and (self.until is None or day < self.until)


class Ratio(Section):
    """The first fact divided by the others."""

    divide: list[str] = Field(min_length=2, description="names of facts")


class ModeEntry(Section):
    """A read-out mode; pixel scale and gain are names of facts."""

    lenslets: Literal[1, 2] = Field(description="lenslets per side of the pupil")
    frame_rate_hz: float = Field(gt=0, description="frame rate of the loop")
    pixel_scale: str = Field(description="name of the fact with the pixel scale")
    apd_gain: str = Field(description="name of the fact with the avalanche gain")


def _as_list(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


class SeeingScaleEntry(Section):
    """A seeing monitor; ratio and offset are names of facts."""

    ratio: str = Field(description="name of the fact with SPARTA's seeing over the monitor's")
    offset_arcsec: str = Field(description="name of the fact with what is added then")


class Profile(Section):
    """The whole file."""

    name: str = Field(min_length=1, description="name of the instrument")
    title: str = Field("", description="one line for people")
    facts: dict[str, Annotated[list[Fact], BeforeValidator(_as_list)]] = Field(
        description="what is known, by name: {value, unit, status, source} each, or a list of them with dates"
    )
    defaults: dict[str, str | Ratio] = Field({}, description="side-car key: fact that stands in for it")
    seeing_scales: dict[str, SeeingScaleEntry] = Field({}, description="monitor: its relation to SPARTA")
    modes: dict[str, ModeEntry] = Field({}, description="mode string of the header: properties")
    lenslets: dict[str, Any] = Field({}, description="side-car keys that hold in modes with lenslets")

    zenith: ZenithSection | None = Field(None, description="direction of the zenith in the image")
    pupil: PupilSection | None = Field(None, description="drawing of the pupil, beyond its facts")

    @model_validator(mode="after")
    def _consistent(self) -> "Profile":
        unknown = [key for key in self.defaults if key not in DEFAULTS]
        if unknown:
            raise ValueError(
                f"defaults: unknown side-car key '{unknown[0]}'{suggestion(unknown[0], DEFAULTS)}"
            )
        self._require_facts()
        for key, name, unit in self._uses():
            for entry in self.facts.get(name, ()) if unit is not None else ():
                try:
                    require_unit(name, entry.unit, str(unit))
                except ValueError as problem:
                    raise ValueError(f"{key}: {problem}") from None
        return self

    def _require_facts(self) -> None:
        """Check names, units, dates and values of the facts."""
        needed = [name for name, rule in FACTS.items() if rule.required]
        if any(name in self.facts for name in OF_A_SKY):
            needed += [*OF_A_SKY, "photons_per_s_m15"]
        for name in [*needed, *(["amplifier_e_per_adu"] if self.modes else [])]:
            if name not in self.facts:
                text = FACTS[name].text
                raise ValueError(f"fact '{name}' is missing ({text}); docs/instruments.md lists all")
        known = {*FACTS, *(name for _, name, _ in self._uses())}
        for name, entries in self.facts.items():
            if name not in known and not re.fullmatch(FAMILIES, name):
                raise ValueError(f"unknown fact '{name}'{suggestion(name, FACTS)}")
            for entry in entries:
                if entry.since and entry.until and entry.since >= entry.until:
                    raise ValueError(f"fact '{name}': since {entry.since} is not before until {entry.until}")
                unit = FACTS[name].unit if name in FACTS else unit_of_name(name)
                if unit is not None:
                    require_unit(name, entry.unit, unit)
                if name in FACTS:
                    _require_value(name, FACTS[name], entry.value)
        if ("pupil_vanes_m" in self.facts) != ("pupil_vane_width_m" in self.facts):
            raise ValueError(
                "facts 'pupil_vanes_m' and 'pupil_vane_width_m' belong together; give both or none"
            )
        for diameter in self.facts["pupil_diameter_m"]:
            for cutoff in self.facts.get("ao_cutoff_per_m", ()):
                cycles = cutoff.value * diameter.value  # below 1 nothing is corrected, many are a mistake
                if not 1 < cycles <= MOST_CYCLES:
                    raise ValueError(
                        f"fact 'ao_cutoff_per_m' = {cutoff.value:g} is {cycles:g} cycles per pupil diameter; "
                        f"it should be 1/(2 actuator pitch), between 1 and {MOST_CYCLES} of them"
                    )

    def _uses(self) -> Iterator[tuple[str, str, str | None]]:
        """Keys that refer to facts: key, fact, and the unit of the key where the fact is its value."""
        for key, name in self.defaults.items():
            if isinstance(name, str):
                yield f"defaults.{key}", name, unit_of_name(key)
            else:
                yield from ((f"defaults.{key}", one, None) for one in name.divide)
        for mode, entry in self.modes.items():
            yield f"modes.{mode}.pixel_scale", entry.pixel_scale, "mas"
            yield f"modes.{mode}.apd_gain", entry.apd_gain, "1"
        for monitor, scale in self.seeing_scales.items():
            yield f"seeing_scales.{monitor}.ratio", scale.ratio, "1"
            yield f"seeing_scales.{monitor}.offset_arcsec", scale.offset_arcsec, "arcsec"


def _require_value(name: str, rule: FactRule, value: Any) -> None:
    shapes = {
        "number": (_is_number, f"a number from {rule.low:g} to {rule.high:g}"),
        "vanes": (lambda one: _is_list(one, 2, _is_point), "a list of [[x, y], [x, y]] in metres"),
        "lines": (
            lambda one: _is_list(one, 3, _is_number) and min(one) >= 0,
            "a list of [Hz, share_x, share_y]",
        ),
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


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_list(value: Any, length: int, is_item: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and len(value) == length and all(map(is_item, value))


def _is_point(value: Any) -> bool:
    return _is_list(value, 2, _is_number)
