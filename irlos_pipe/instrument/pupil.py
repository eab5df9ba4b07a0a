"""The section `pupil` of a profile: a pupil that is more than a disc with a hole and vanes of one width."""

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, field_validator

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
