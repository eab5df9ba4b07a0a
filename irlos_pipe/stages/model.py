"""The `model:` section of a recipe: the PSF model that calibrate, lift, sensitivity and correct share."""

from __future__ import annotations

import difflib
import inspect
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from irlos_pipe.effects import CATALOGUE


class ModelConfig(BaseModel):
    """What the PSF model contains.

    An effect is named to be estimated (``seeing_halo``), or given with its parameters to be
    held at them (``tip_tilt_jitter: {sigma_mas: 8}``).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    effects: tuple[Annotated[Any, Field()], ...] = Field(
        ("seeing_halo", "tip_tilt_jitter"),
        description="effects beyond the static wavefront, by name, or {name: {parameter: value}} to fix one",
    )
    pupil_samples: int = Field(128, ge=48, le=512, description="samples across the pupil diameter")
    cutoff_per_m: float = Field(2.5, gt=0, le=5, description="AO cut-off, 1/(2 actuator pitch) [1/m]")
    outer_scale_m: float = Field(25.0, gt=1, le=1000, description="outer scale of the turbulence [m]")

    @field_validator("effects", mode="after")
    @classmethod
    def _known_effects(cls, effects: tuple) -> tuple:
        names = [_check_effect(entry) for entry in effects]
        if len(set(names)) != len(names):
            raise ValueError("an effect is listed twice")
        return effects

    def effect_settings(self) -> dict[str, dict[str, float]]:
        """Effect names with their fixed parameters; empty for an effect to be estimated."""
        return {
            name: dict(values)
            for entry in self.effects
            for name, values in ({entry: {}} if isinstance(entry, str) else entry).items()
        }


def _check_effect(entry: Any) -> str:
    """Name of one entry of `effects`; raises ValueError with a suggestion."""
    if isinstance(entry, dict) and len(entry) == 1:
        name, values = next(iter(entry.items()))
    else:
        name, values = entry, {}
    if not isinstance(name, str) or name not in CATALOGUE:
        close = difflib.get_close_matches(str(name), CATALOGUE, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"available: {', '.join(CATALOGUE)}"
        raise ValueError(f"unknown effect {name!r}; {hint}")
    allowed = list(inspect.signature(CATALOGUE[name].values_of).parameters)[1:]
    if not isinstance(values, dict) or (values and sorted(values) != sorted(allowed)):
        raise ValueError(f"{name} is fixed by {{{', '.join(allowed)}}}, not by {values!r}")
    bad = [
        key
        for key, value in values.items()
        if isinstance(value, bool) or not isinstance(value, (int, float)) or value < 0
    ]
    if bad:
        raise ValueError(f"{name}.{bad[0]} must be a number that is not negative")
    return name
