"""Settings of stage `diagnose`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.diagnosis.options import DRIFT_NM
from irlos_pipe.stages.base import StageConfig
from irlos_pipe.stages.diagnose.begin_near import wavefront_of

Noll = Annotated[int, Field(ge=2, le=HIGHEST_NOLL)]
Nanometres = Annotated[float, Field(ge=-5000, le=5000)]


class Config(StageConfig):
    """Settings of the diagnosis."""

    input: str = Field("cube", description="recipe input that holds the cubes, or the ramp")
    highest_noll: int = Field(
        66,
        ge=4,
        le=HIGHEST_NOLL,
        description="modes 2 to this belong to every model; beyond: high_order_ncpa",
    )
    held_out: float = Field(
        0.25,
        gt=0.05,
        le=0.5,
        description="part of the frames, or of the pixels of fewer than 16, that no fit sees",
    )
    most_names: int = Field(4, ge=1, le=10, description="names at which to stop, of each star and night")
    recordings: Literal["auto", "together", "apart"] = Field(
        "auto",
        description="of one star and night (together), each of its own (apart), or as targets and times tell",
    )
    night_drift_nm: float = Field(
        DRIFT_NM,
        gt=0,
        le=100,
        description="prior σ of the change of every mode between stars and nights [nm]",
    )
    sure_sigma: float = Field(5.0, ge=3, le=20, description="significance of a detection")
    begin_near: Annotated[dict[Noll, Nanometres], BeforeValidator(wavefront_of)] = Field(
        {},
        description="a wavefront from which the fit begins as well, Noll index to nm RMS, or the path of a "
        "run that found it in another recording",
    )
