"""Settings of `irlos night`: recipes by kind of group, how recordings are grouped, when a number alarms."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files import shipped
from irlos_pipe.files.shipped import named_file
from irlos_pipe.files.validation import Origins, Section, absolute, require_valid
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.results import item
from irlos_pipe.readers.sidecar import AcquisitionKeys

Kind = Literal["calibration", "ramp", "derotator", "psf", "two_by_two"]
RECIPES: dict[Kind, list[str]] = {
    "calibration": ["ncpa_calibration", "diagnose"],
    "ramp": ["defocus_ramp"],
    "derotator": ["derotator"],
    "psf": [],
    "two_by_two": ["two_by_two"],
}

Limits = tuple[float | None, float | None]
# Names of the numbers that `numbers` takes from a run, besides those of the modes.
OTHER_NUMBERS = (
    "ncpa_nm", "seeing_arcsec", "ao_residual_nm", "jitter_mas", "chi2_nu", "defocus_bias_nm", "ramp_slope",
    "ramp_error_nm", "focus_2x2_nm", "gap_before", "gap_after", "gap_floor",
)  # fmt: skip
NUMBER = re.compile("|".join([r"noll_[1-9]\d*_nm", *OTHER_NUMBERS]))


class BandSettings(Section):
    """When a number counts as out of its band; see `bands.band_of`."""

    false_alarm: float = item(1e-4, "false-alarm probability per number", gt=0, lt=0.5)
    nights: int = item(60, "number of latest earlier nights used", ge=3, le=10000)
    least_nights: int = item(
        5, "fewest earlier nights that give a band to a number without error", ge=3, le=1000
    )
    least_nights_with_errors: int = item(
        3, "fewest earlier nights that give a band to a number with an error", ge=2, le=1000
    )
    limits: dict[str, Limits] = item(
        {}, "number: [low, high], null for no limit; alarms also where the sky decides"
    )
    valid_change_nm: float = item(
        20.0, "RMS change of the NCPAs until which a calibration is valid [nm]", gt=0
    )

    @field_validator("limits")
    @classmethod
    def _in_order(cls, limits: dict[str, Limits]) -> dict[str, Limits]:
        for name, (low, high) in limits.items():
            if not NUMBER.fullmatch(name):
                raise ValueError(f"'{name}' is no number of a trend{suggestion(name, OTHER_NUMBERS)}")
            if low is None and high is None:
                raise ValueError(f"'{name}': both limits are null; leave it out")
            if low is not None and high is not None and low >= high:
                raise ValueError(f"'{name}': the lower limit {low:g} is not below the upper one {high:g}")
        return limits


class NightSettings(Section):
    """The file given with ``--config``; every key is optional."""

    instrument: str = item("irlos", "profile of recordings whose side-cars state none")
    acquisition: AcquisitionKeys = item(AcquisitionKeys(), "side-car keys that override the side-cars")
    recipes: dict[Kind, list[str]] = item(
        {}, "recipes by kind of group: names, or paths relative to this file"
    )
    settings: dict[str, dict[str, Any]] = item({}, "recipe name: {stage.key: value}")
    series_gap_min: float = item(30.0, "longest time between two recordings of a series [min]", gt=0, le=1440)
    calibration_nights: int = item(
        7, "a ramp may use a calibration up to this many nights away", ge=0, le=400
    )
    limit_min: float = item(60.0, "longest time for one reduction [min]; it is stopped then", gt=0)
    band: BandSettings = Field(default=BandSettings())

    def recipes_of(self, kind: Kind) -> list[Path]:
        return [Path(path) for path in self.recipes[kind]]


def load_settings(path: Path | None = None, recipes: Iterable[str] = ()) -> NightSettings:
    """Read the settings file at `path`, if there is one, and the `recipes` named on the command line.

    Those are ``KIND=PATH``, relative to the current folder, or ``KIND=NAME``; a kind given again is a list.

    Raises `ConfigurationError` with one line ``where: message`` for every validation error.
    """
    settings, folder = NightSettings(), None
    if path is not None:
        data, lines = load_yaml(path)
        settings, folder = require_valid(data, NightSettings, Origins(path, lines)), absolute(path).parent
    chosen = {kind: [_recipe(name) for name in names] for kind, names in RECIPES.items()}
    chosen |= {kind: [_recipe(name, folder) for name in names] for kind, names in settings.recipes.items()}
    chosen |= _by_kind(recipes)
    known = {recipe.stem for paths in chosen.values() for recipe in paths}
    for name in settings.settings:
        if name not in known:
            raise ConfigurationError(f"{path}: settings.{name}: no such recipe{suggestion(name, known)}")
    _require_different_names(chosen)
    absolute_recipes = {kind: list(map(str, paths)) for kind, paths in chosen.items()}
    return settings.model_copy(update={"recipes": absolute_recipes})


def _recipe(given: str, folder: Path | None = None) -> Path:
    """A recipe by its path, counted from `folder`, or by the name of one that comes with the package."""
    path = absolute(given, folder)
    return path if path.is_file() else absolute(named_file(given, shipped.RECIPES), folder)


def _require_different_names(chosen: Mapping[Kind, Iterable[Path]]) -> None:
    """Refuse recipes of one name for one kind: their results would go to one folder."""
    for kind, paths in chosen.items():
        by_name: dict[str, Path] = {}
        for path in paths:
            other = by_name.setdefault(path.stem, path)
            if other is not path:
                raise ConfigurationError(
                    f"recipes for groups of kind {kind}: {other} and {path} have the same name, "
                    "and so would their folders of results; rename one, or give it once"
                )


def _by_kind(recipes: Iterable[str]) -> dict[Kind, list[Path]]:
    """Sort ``KIND=PATH`` options by kind."""
    found: dict[Kind, list[Path]] = {}
    for option in recipes:
        name, equals, path = option.partition("=")
        if not equals or not path:
            raise ConfigurationError(
                f"--recipe {option}: expected KIND=PATH, for example ramp=full_reduction"
            )
        kind = next((one for one in RECIPES if one == name), None)
        if kind is None:
            raise ConfigurationError(f"--recipe {option}: no such kind of group{suggestion(name, RECIPES)}")
        found.setdefault(kind, []).append(_recipe(path))
    return found
