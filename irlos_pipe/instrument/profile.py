"""The keys of the YAML file of an instrument profile."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.validation import Origins, require_valid
from irlos_pipe.instrument.facts import DEFAULTS, require_facts, require_used_units
from irlos_pipe.instrument.pupil import PupilSection, ZenithSection
from irlos_pipe.instrument.status import Status
from irlos_pipe.instrument.units import unit_of_name


class _Section(BaseModel):
    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True, allow_inf_nan=False)


def _iso_date(value: Any) -> Any:
    return value.isoformat() if isinstance(value, date) else value


IsoDate = Annotated[str, BeforeValidator(_iso_date), Field(pattern=r"^\d{4}-\d\d-\d\d$")]


class Fact(_Section):
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
    def _consistent(self) -> Profile:
        unknown = [key for key in self.defaults if key not in DEFAULTS]
        if unknown:
            raise ValueError(
                f"defaults: unknown side-car key '{unknown[0]}'{suggestion(unknown[0], DEFAULTS)}"
            )
        require_facts(self.facts, self._used(), modes=bool(self.modes))
        require_used_units(self.facts, self._uses())
        return self

    def _uses(self) -> Iterator[tuple[str, str, str | None]]:
        """Keys that a fact gives as it is: the key, the fact, and the unit of the key."""
        for key, name in self.defaults.items():
            if isinstance(name, str):
                yield f"defaults.{key}", name, unit_of_name(key)
        for mode, entry in self.modes.items():
            yield f"modes.{mode}.pixel_scale", entry.pixel_scale, "mas"
            yield f"modes.{mode}.apd_gain", entry.apd_gain, "1"
        for monitor, scale in self.seeing_scales.items():
            yield f"seeing_scales.{monitor}.ratio", scale.ratio, "1"
            yield f"seeing_scales.{monitor}.offset_arcsec", scale.offset_arcsec, "arcsec"

    def _used(self) -> set[str]:
        """Names of facts to which other sections refer."""
        references = self.defaults.values()
        of_defaults = (name for one in references for name in ([one] if isinstance(one, str) else one.divide))
        of_modes = (name for mode in self.modes.values() for name in (mode.pixel_scale, mode.apd_gain))
        of_scales = (name for one in self.seeing_scales.values() for name in (one.ratio, one.offset_arcsec))
        return {*of_defaults, *of_modes, *of_scales}


def parse_profile(data: dict, lines: dict, path: Path) -> Profile:
    """Return the profile in `data`, read from `path` with the `lines` of its keys.

    Raises
    ------
    ConfigurationError
        One line ``file:line: problem`` for everything that is wrong.
    """
    return require_valid(data, Profile, Origins(path, lines))
