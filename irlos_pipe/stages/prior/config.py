"""Settings of stage `prior`."""

from __future__ import annotations

from pydantic import Field

from irlos_pipe.stages.base import StageConfig


class Config(StageConfig):
    """Settings of the elongation prior."""

    input: str = Field("ramp", description="recipe input whose frames get a prior")
    max_failed_fraction: float = Field(0.1, ge=0, le=1, description="QC limit on Gaussian fits that fail")
