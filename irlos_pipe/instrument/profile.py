"""The keys of the YAML file of an instrument profile."""

from __future__ import annotations

import math
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from irlos_pipe.files.validation import Origins, require_valid

# Facts that must be there, and the range a number must keep to make sense.
REQUIRED_FACTS = {
    "pupil_diameter_m": (0.01, 100),
    "pupil_obscuration_m": (0, 100),
    "pupil_vane_width_m": (0, 10),
    "photons_per_s_m15": (1e-6, 1e12),
    "amplifier_e_per_adu": (1e-9, 1e6),
    "ao_cutoff_per_m": (1e-3, 1e3),
    "outer_scale_m": (1, 1000),
    "ao_residual_nm_per_arcsec": (0, 1e4),
    "ao_residual_floor_nm": (0, 1e4),
    "ncpa_amplitude_nm": (0, 1e4),
    "ncpa_decay": (0, 100),
    "ncpa_plateau_nm": (0, 1e4),
    "seeing_arcsec": (0.01, 10),
}


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _iso_date(value: Any) -> Any:
    return value.isoformat() if isinstance(value, date) else value


IsoDate = Annotated[str, BeforeValidator(_iso_date), Field(pattern=r"^\d{4}-\d\d-\d\d$")]


class Fact(_Section):
    """One value with its unit, its source, how far to trust it, and when it held."""

    value: Any = Field(description="the value itself")
    unit: str = Field(description="unit as text; '1' for a pure number")
    source: str = Field(min_length=1, description="where the value comes from")
    status: Literal["adopted", "published", "unverified", "assumed"]
    since: IsoDate | None = Field(None, description="first day on which the value held")
    until: IsoDate | None = Field(None, description="first day on which it no longer held")

    def holds_on(self, day: str | None) -> bool:
        """Return whether the value held on an ISO date `day`; None stands for the present."""
        if day is None:
            return self.until is None
        return (self.since is None or self.since <= day) and (self.until is None or day < self.until)


class Ratio(_Section):
    """The first fact divided by the others."""

    divide: list[str] = Field(min_length=2, description="names of facts")


class ModeEntry(_Section):
    """A read-out mode; pixel scale and gain are names of facts."""

    lenslets: Literal[1, 2] = Field(description="lenslets per side of the pupil")
    frame_rate_hz: float = Field(gt=0, description="frame rate of the loop")
    pixel_scale: str = Field(description="name of the fact with the pixel scale")
    apd_gain: str = Field(description="name of the fact with the avalanche gain")


def _as_list(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


class SeeingScaleEntry(_Section):
    """A seeing monitor; ratio and offset are names of facts."""

    ratio: str = Field(description="name of the fact with SPARTA's seeing over the monitor's")
    offset_arcsec: str = Field(description="name of the fact with what is added then")


class Profile(_Section):
    """The whole file."""

    name: str = Field(min_length=1, description="name of the instrument")
    title: str = Field("", description="one line for people")
    facts: dict[str, Annotated[list[Fact], BeforeValidator(_as_list)]]
    defaults: dict[str, str | Ratio] = Field({}, description="side-car key: fact that stands in for it")
    seeing_scales: dict[str, SeeingScaleEntry] = Field({}, description="monitor: its relation to SPARTA")
    modes: dict[str, ModeEntry] = Field({}, description="mode string of the header: properties")

    @model_validator(mode="after")
    def _require_facts(self) -> Profile:
        for name, (low, high) in REQUIRED_FACTS.items():
            _require_number(name, self.facts.get(name), low, high)
        _require_vanes(self.facts.get("pupil_vanes_m"))
        _require_lines(self.facts.get("vibration_lines", []))
        return self


def parse_profile(data: dict, lines: dict, path: Path) -> Profile:
    """Return the profile in `data`, read from `path` with the `lines` of its keys.

    Raises
    ------
    ConfigurationError
        One line ``file:line: problem`` for everything that is wrong.
    """
    return require_valid(data, Profile, Origins(path, lines))


def _require_number(name: str, entries: list[Fact] | None, low: float, high: float) -> None:
    if entries is None:
        raise ValueError(f"fact '{name}' is missing; the profile 'irlos' shows all facts")
    for entry in entries:
        if not isinstance(entry.value, (int, float)) or not low <= entry.value <= high:
            raise ValueError(f"fact '{name}' = {entry.value!r} should be a number from {low:g} to {high:g}")


def _require_vanes(entries: list[Fact] | None) -> None:
    if entries is None:
        raise ValueError("fact 'pupil_vanes_m' is missing")
    for entry in entries:
        if not isinstance(entry.value, list) or not all(map(_is_segment, entry.value)):
            raise ValueError("fact 'pupil_vanes_m' should be a list of [[x, y], [x, y]] in metres")


def _require_lines(entries: list[Fact]) -> None:
    for entry in entries:
        if not isinstance(entry.value, list) or not all(map(_is_line, entry.value)):
            raise ValueError("fact 'vibration_lines' should be a list of [Hz, share_x, share_y]")


def _is_line(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and _are_finite(value) and min(value) >= 0


def _is_segment(value: Any) -> bool:
    points = value if isinstance(value, list) and len(value) == 2 else []
    return len(points) == 2 and all(
        isinstance(point, list) and len(point) == 2 and _are_finite(point) for point in points
    )


def _are_finite(numbers: list) -> bool:
    return all(isinstance(number, (int, float)) and math.isfinite(number) for number in numbers)
