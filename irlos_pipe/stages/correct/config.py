"""Settings of stage `correct`."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator, Field

from irlos_pipe.stages.base import StageConfig
from irlos_pipe.stages.correct.mirror_file import MirrorFile, mirror_file


class Config(StageConfig):
    """Settings of the correction."""

    input: str = Field("calibration", description="recipe input whose configuration the prediction uses")
    gain: float = Field(1.0, gt=0, le=1, description="part of the measured aberration to correct")
    mirror_modes: Annotated[MirrorFile | None, BeforeValidator(mirror_file)] = Field(
        None, description="FITS cube of a mirror's modes, n × n OPD maps across the pupil [nm per unit]"
    )
