"""Settings of stage `derotator`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.stages.base import StageConfig


class Config(StageConfig):
    """Settings of the derotator test."""

    sense: Literal["estimate", "anticlockwise", "clockwise"] = Field(
        "estimate", description="sense in which the wavefront before the derotator turns with growing angle"
    )
    turn_per_degree: float = Field(
        1.0,
        gt=0,
        le=2,
        description="rotation of the image per degree of the angle; 2 for the angle of a K-mirror",
    )
    highest_noll: int | None = Field(
        None, ge=4, le=HIGHEST_NOLL, description="highest Noll mode used; null: all estimated modes"
    )
    max_chi2_nu: float = Field(
        10.0, gt=0, description="QC limit on how well the two parts explain the single estimates"
    )
