"""The YAML file of an instrument profile: its keys, and the facts that it may state.

Its section `pupil` is for a pupil that is more than a disc with a hole and vanes of one width.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from datetime import date
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError, field_validator, model_validator

from irlos_pipe.conventions.pupil_drawing import (
    ON_AXIS,
    PupilGeometry,
    Vane,
    clear_fraction,
    outline_cover,
    placed,
)
from irlos_pipe.conventions.pupil_parts import PARTS, AmplitudeMap, Flip, Part, Placement, Samples
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.regular import first_image
from irlos_pipe.files.validation import Section

# How far a value can be trusted. adopted: the project's convention; published: in a refereed paper or report
# of the observatory; unverified: seen in public code or headers only; assumed: does little harm if wrong
Status = Literal["adopted", "published", "unverified", "assumed"]
PLACEMENT_KEYS = ("rotation_deg", "flip", "centre_m")
SCALE_KEYWORD = "PUPLSCAL"  # of the header of a map, metres per sample, as poppy writes it
Point = tuple[float, float]
CELLS = 256  # across the diameter: a hole of a hundredth of it, as of an aperture mask, has five
# Neighbours whose coordinates are rounded to millimetres overlap by less; where they do, the amplitude is 2.
MOST_OVERLAP = 1e-3  # of the aperture's area
LEAST_LIGHT = 1e-3  # of the disc's; aperture masks pass some per cents
# A map of half the scale, or a diameter in other units, ends before this; stops and aperture masks do not.
# Of a Zernike polynomial of order n, a pupil that ends at x of the rim sees x^n: 4 % of one of order 8.
LEAST_REACH = 2 / 3  # of half the diameter


class VaneEntry(Section):
    """A vane with a width of its own."""

    start_m: Point = Field(description="[x, y] where its middle line starts")
    end_m: Point = Field(description="[x, y] where it ends")
    width_m: float = Field(gt=0, description="full width")


class MapEntry(Section):
    """A FITS image of amplitudes between 0 and 1."""

    file: str = Field(min_length=1, description="path of the FITS file, counted from the profile")
    metres_per_sample: float | None = Field(
        None, gt=0, description=f"scale; the header's {SCALE_KEYWORD} if left out"
    )


class TurnRule(Section):
    """How the pupil turns on the detector: offset + Σ factor · angle, anticlockwise."""

    offset_deg: float = Field(0.0, ge=-720, le=720, description="at angles of zero")
    parallactic: float = Field(0.0, ge=-4, le=4, description="factor of the parallactic angle")
    derotator: float = Field(0.0, ge=-4, le=4, description="factor of the derotator's angle")
    altitude: float = Field(0.0, ge=-4, le=4, description="factor of the telescope's altitude")

    @property
    def factors(self) -> dict[str, float]:
        """The factors that are not zero, by the key of the side-car that has the angle."""
        names = ("parallactic", "derotator", "altitude")
        keys = ("parallactic_angle_deg", "derotator_angle_deg", "altitude_deg")
        return {
            key: getattr(self, name) for key, name in zip(keys, names, strict=True) if getattr(self, name)
        }

    def rotation_deg(self, angles_deg: Mapping[str, float]) -> float:
        """Return the angle of the pupil for the `angles_deg` of a recording, by key of the side-car."""
        return (self.offset_deg + sum(f * angles_deg[key] for key, f in self.factors.items())) % 360


class ZenithSection(TurnRule):
    """Direction of the zenith in the image, from +x towards +y: offset + Σ factor · angle."""

    source: str = Field(min_length=1, description="where the rule comes from")
    status: Status = Field(description="how far to trust it")


class PupilSection(Section):
    """What the facts of the pupil leave out; these still give diameter, central hole and plain vanes."""

    source: str = Field(min_length=1, description="where the drawing comes from")
    status: Status = Field(description="how far to trust it")
    aperture: tuple[dict[str, Any], ...] = Field(
        (), description="parts that light passes, one {name: {key: value}} each; the disc if left out"
    )
    obstructions: tuple[dict[str, Any], ...] = Field((), description="parts that stand in the way")
    vanes: tuple[VaneEntry, ...] = Field((), description="vanes with widths of their own")
    map: MapEntry | None = Field(None, description="FITS image of the aperture, instead of parts")
    rotation_deg: float = Field(0.0, ge=-720, le=720, description="of all that is drawn, anticlockwise")
    flip: Flip = Field("none", description="x exchanges left and right, y up and down, before the rotation")
    shift_m: Point = Field((0.0, 0.0), description="[x, y], after the rotation")
    turns: TurnRule | None = Field(None, description="how the pupil turns on the detector during the night")

    @field_validator("aperture", "obstructions")
    @classmethod
    def _known_parts(cls, entries: tuple[dict[str, Any], ...]) -> tuple[dict[str, Any], ...]:
        for entry in entries:
            part_of(entry)
        return entries


def drawn(plain: PupilGeometry, section: PupilSection, folder: Path) -> PupilGeometry:
    """Return the pupil of a profile: `plain` disc, hole and vanes of the facts, and what `section` draws.

    Raises `ValueError` for parts that contradict each other, and a map, whose path counts from `folder`, that
    cannot be used.
    """
    if section.map and section.aperture:
        raise ValueError("map and aperture both say what light passes; give one of them")
    if section.vanes and plain.vanes:
        raise ValueError("vanes and the fact 'pupil_vanes_m' both give vanes; give one of them")
    aperture = tuple(part_of(entry) for entry in section.aperture)
    if section.map:
        aperture = (read_map(folder / section.map.file, section.map.metres_per_sample),)
    own = tuple(Vane(vane.start_m, vane.end_m, vane.width_m) for vane in section.vanes)
    geometry = PupilGeometry(
        plain.diameter_m,
        plain.obscuration_m,
        plain.vanes or own,
        aperture,
        tuple(part_of(entry) for entry in section.obstructions),
    )
    placement = Placement.of(section.rotation_deg, section.flip, section.shift_m)
    try:
        return placed(geometry, placement)
    except ValueError as problem:
        # the shifted pupil no longer lies on the disc, to which the model's grid is cut
        needed_m = geometry.diameter_m + 2 * float(np.hypot(*placement.shift_m))
        disc = f" and the disc as aperture: [{{circle: {{diameter_m: {geometry.diameter_m:g}}}}}]"
        raise ValueError(
            f"{problem}; pupil_diameter_m is that of a disc about the axis that holds all of the shifted "
            f"pupil: give {needed_m:.4g}{'' if geometry.aperture else disc}"
        ) from None


def part_of(entry: dict[str, Any]) -> Part:
    """Return the part that ``{name: {key: value}}`` describes.

    Raises `ValueError` that names the nearest known name or key, or the value that does not fit.
    """
    if len(entry) != 1 or not isinstance(next(iter(entry.values())), dict):
        raise ValueError(f"a part is {{name: {{key: value}}}}, not {entry!r}; parts: {', '.join(PARTS)}")
    name, given = next(iter(entry.items()))
    if name not in PARTS:
        raise ValueError(f"unknown part '{name}'{suggestion(name, PARTS)}")
    kind = PARTS[name]
    own = {one.name: one for one in fields(kind) if one.name != "placement"}
    for key in given:
        if key not in own and key not in PLACEMENT_KEYS:
            raise ValueError(f"{name}: unknown key '{key}'{suggestion(key, [*own, *PLACEMENT_KEYS])}")
    for key, one in own.items():
        if key not in given and one.default is MISSING:
            raise ValueError(f"{name}: key '{key}' is missing")
    placement = Placement.of(
        _checked(name, "rotation_deg", float, given.get("rotation_deg", 0.0)),
        _checked(name, "flip", Flip, given.get("flip", "none")),
        _checked(name, "centre_m", Point, given.get("centre_m", (0.0, 0.0))),
    )
    assert is_dataclass(kind), "parts are dataclasses"
    return _checked(name, "", kind, {key: given[key] for key in own if key in given}).placed(placement)


def _checked(name: str, key: str, kind: Any, value: Any) -> Any:
    """`value` as a `kind`."""
    try:
        return TypeAdapter(kind, config=None).validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join([name, *filter(None, [key]), *map(str, first["loc"])])
        problem = first["msg"].removeprefix("Value error, ").removeprefix(f"{name}: ")
        shown = f" = {first['input']!r}" if first["type"] != "value_error" else ""
        raise ValueError(f"{where}{shown}: {problem}") from None


def read_map(path: Path, metres_per_sample: float | None = None) -> AmplitudeMap:
    """Read the amplitude of a pupil from the first image of the FITS file `path`.

    Raises `ValueError` for a file that cannot be read, a scale that neither `metres_per_sample` nor the
    header states, and samples that are no amplitudes.
    """
    try:
        values, header = first_image(path)
    except ValueError as error:
        raise ValueError(f"map {path.name} {error}") from None
    scale = metres_per_sample or header.get(SCALE_KEYWORD)
    if not isinstance(scale, (int, float)) or not np.isfinite(scale):
        raise ValueError(
            f"map {path.name} has no scale; give map.metres_per_sample, or {SCALE_KEYWORD} in its header"
        )
    try:
        return AmplitudeMap(Samples.of(values), float(scale))
    except ValueError as problem:
        raise ValueError(f"{problem} ({path.name})") from None


@lru_cache(maxsize=16)
def require_usable(geometry: PupilGeometry) -> None:
    """Raise ValueError where the light that the pupil `geometry` passes on a grid makes no sense.

    The message says in one line what is wrong and what to correct.
    """
    rim_m = geometry.diameter_m / 2
    step_m = geometry.diameter_m / CELLS
    axis_m = (np.arange(CELLS + 2) - (CELLS + 1) / 2) * step_m
    x_m, y_m = axis_m[None, :], axis_m[:, None]
    pieces = np.zeros((y_m.size, x_m.size), int)
    for piece in () if geometry.map else geometry.segments:
        box = rows, columns = piece.box(x_m, y_m, step_m)
        inside_m = piece.distance_m(*piece.placement.back(x_m[:, columns], y_m[rows]))
        pieces[box] += inside_m > 1e-6 * step_m
    overlap = int(np.sum(pieces > 1)) / max(int(np.sum(pieces > 0)), 1)
    if overlap > MOST_OVERLAP:
        raise ValueError(
            f"the parts of the aperture overlap: {overlap:.2g} of its area is covered twice; draw it once"
        )
    # edges that meet leave a part of a cell clear, which is no light
    aperture = outline_cover(replace(geometry, obscuration_m=0.0), x_m, y_m, step_m, ON_AXIS)
    lit = clear_fraction(geometry, x_m, y_m, step_m) > min(aperture.max(), 1.0) / 2
    light = lit.sum() * step_m**2 / (np.pi * rim_m**2)
    if light < LEAST_LIGHT:
        passed = f"only {light:.1g} of the light" if lit.any() else "no light"
        raise ValueError(f"it lets {passed} on its disc pass; compare aperture, hole, obstructions and vanes")
    reach_m = np.hypot(x_m, y_m)[lit].max()
    if reach_m < LEAST_REACH * rim_m:
        raise ValueError(
            f"what passes light ends {reach_m:.3g} m from the axis, before {LEAST_REACH:.2g} of half the "
            f"diameter, {rim_m:g} m; correct pupil_diameter_m, or the scale of what is drawn"
        )


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
