"""The `model:` section of a recipe: the PSF model that calibrate, lift, sensitivity and correct share."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.stages.model.effect_entry import EffectEntry


class ModelConfig(BaseModel):
    """What the PSF model contains.

    An effect is named to be estimated (``seeing_halo``), given with its parameters to be held at them
    (``tip_tilt_jitter: {sigma_mas: 8}``), or to be estimated from there (the same and ``fit: true``).
    Some have options besides (``vibration: {shape: gaussian}``). Several companions, phase bumps or biases
    of parts of a ramp are listed one by one; results name the second ``companion_2``.
    """

    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True)

    effects: tuple[Annotated[Any, Field()], ...] = Field(
        ("seeing_halo", "tip_tilt_jitter"),
        description="effects beyond the static wavefront, by name, or {name: {parameter: value}} to fix one",
    )
    colour: Literal["auto", "listed"] = Field(
        "auto",
        description="auto: atmospheric dispersion and the star's colour belong to the model of calibrate and "
        "lift where the band is broad and there is an AO residual; listed: only what effects lists",
    )
    pupil_samples: int = Field(128, ge=48, le=512, description="samples across the pupil diameter")
    cutoff_per_m: float | None = Field(
        None,
        ge=0.01,
        le=1000,
        description="AO cut-off, 1/(2 actuator pitch) [1/m]; that of the instrument if left out",
    )
    outer_scale_m: float | None = Field(
        None, gt=1, le=1000, description="outer scale of the turbulence [m]; the instrument's if left out"
    )

    @field_validator("effects", mode="after")
    @classmethod
    def _known_effects(cls, effects: tuple) -> tuple:
        names = [EffectEntry.of(entry).name for entry in effects]
        again = sorted({name for name in names if names.count(name) > 1 and not CATALOGUE[name].repeatable})
        if again:
            raise ValueError(f"an effect is listed twice: {', '.join(again)}")
        return effects

    def completed(self, facility: Facility) -> ModelConfig:
        """Return the section with what it leaves out taken from the `facility`."""
        absent = [name for name in ("cutoff_per_m", "outer_scale_m") if getattr(self, name) is None]
        return self.model_copy(update={name: getattr(facility, name) for name in absent})

    def entries(self) -> list[EffectEntry]:
        """The effects one by one."""
        return [EffectEntry.of(entry) for entry in self.effects]
