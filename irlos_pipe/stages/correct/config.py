"""Settings of stage `correct`."""

from __future__ import annotations

from pydantic import Field

from irlos_pipe.stages.base import StageConfig


class Config(StageConfig):
    """Settings of the correction."""

    input: str = Field("calibration", description="recipe input whose configuration the prediction uses")
    gain: float = Field(1.0, gt=0, le=1, description="part of the measured aberration to correct")
