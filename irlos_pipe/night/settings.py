"""What `irlos night` can be told: which recipe serves which kind of group, and when a trend is alarming."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.overrides import absolute
from irlos_pipe.files.validation import read_validated
from irlos_pipe.night.grouping import KINDS
from irlos_pipe.readers.sidecar import AcquisitionKeys

Kind = Literal["calibration", "ramp", "derotator", "psf"]
RECIPES = {
    "calibration": ["recipes/ncpa_calibration.yaml", "recipes/diagnose.yaml"],
    "ramp": ["recipes/defocus_ramp.yaml"],
    "derotator": ["recipes/derotator.yaml"],
    "psf": [],
}


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class BandKeys(_Section):
    """When a number counts as out of its band, which is that of the nights before; see `stability`."""

    false_alarm: float = Field(1e-4, gt=0, lt=0.5, description="probability per number")
    nights: int = Field(60, ge=3, le=10000, description="earlier nights that make the band, the latest ones")
    least_nights: int = Field(5, ge=3, le=1000, description="nights below which there is no band")


class NightSettings(_Section):
    """The file given with --config; all may be left out."""

    instrument: str = Field("irlos", description="instrument profile for reading the recordings")
    acquisition: AcquisitionKeys = Field(AcquisitionKeys(), description="side-car keys that win")
    recipes: dict[Kind, list[str]] = Field({}, description="recipes by kind of group, relative to this file")
    settings: dict[str, dict[str, Any]] = Field({}, description="recipe name: {stage.key: value}")
    series_gap_min: float = Field(30.0, gt=0, le=1440, description="longest pause within a ramp or series")
    calibration_nights: int = Field(7, ge=0, le=400, description="nights a calibration serves ramps")
    band: BandKeys = BandKeys()

    def recipes_of(self, kind: str) -> list[Path]:
        """Return the recipes that serve a kind of group."""
        return [Path(path) for path in self.recipes[kind]]


def load_settings(path: Path | None = None, recipes: Iterable[str] = ()) -> NightSettings:
    """Read the file, if there is one, and what the command line says about recipes.

    Parameters
    ----------
    recipes : iterable of str
        ``KIND=PATH``, relative to the current folder; a kind given again makes a list.

    Raises
    ------
    ConfigurationError
        With one line ``where: message`` for everything that is wrong.
    """
    settings = NightSettings() if path is None else _read(path)
    folder = None if path is None else absolute(path).parent
    chosen = {kind: [absolute(name) for name in names] for kind, names in RECIPES.items()}
    chosen |= {kind: [absolute(name, folder) for name in names] for kind, names in settings.recipes.items()}
    chosen |= _given(recipes)
    known = {recipe.stem for paths in chosen.values() for recipe in paths}
    for name in settings.settings:
        if name not in known:
            raise ConfigurationError(f"{path}: settings.{name}: no such recipe{suggestion(name, known)}")
    absolute_recipes = {kind: list(map(str, paths)) for kind, paths in chosen.items()}
    return settings.model_copy(update={"recipes": absolute_recipes})


def _read(path: Path) -> NightSettings:
    return read_validated(path, NightSettings)


def _given(recipes: Iterable[str]) -> dict[str, list[Path]]:
    given: dict[str, list[Path]] = {}
    for text in recipes:
        kind, equals, path = text.partition("=")
        if not equals or not path:
            raise ConfigurationError(
                f"--recipe {text}: expected KIND=PATH, for example ramp=recipes/full_reduction.yaml"
            )
        if kind not in KINDS:
            raise ConfigurationError(f"--recipe {text}: no such kind of group{suggestion(kind, KINDS)}")
        given.setdefault(kind, []).append(absolute(path))
    return given
