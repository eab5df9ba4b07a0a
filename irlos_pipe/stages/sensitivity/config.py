"""Settings of stage `sensitivity`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from irlos_pipe.stages.base import StageConfig
from irlos_pipe.stages.lift.config import Mode


class Config(StageConfig):
    """Settings of the sensitivity scan."""

    input: str = Field("ramp", description="recipe input that holds the ramp")
    max_defocus_nm: float = Field(
        170.0, gt=0, description="frames with a larger introduced defocus are left out"
    )
    mag_step: float = Field(1.0, ge=0.05, le=5, description="step of the magnitude grid")
    faintest_mag_j: float = Field(
        19.0, ge=0, le=30, description="end of the magnitude grid, which begins at the magnitude of the ramp"
    )
    realisations: int = Field(5, ge=1, le=1000, description="noise realisations per frame and magnitude")
    frames_per_offset: int = Field(2, ge=1, le=1000, description="number of frames used of every offset")
    modes: tuple[tuple[Mode, ...], ...] = Field(
        ((2, 3, 4), (2, 3, 4, 5, 7, 8, 9, 10, 11)),
        max_length=20,
        description="sets of Noll modes to be estimated",
    )
    calibrated: tuple[bool, ...] = Field(
        (True, False), description="whether the NCPAs are known: with, without, or both"
    )
    limit_nm: float = Field(30.0, gt=0, description="largest median error at the limiting magnitude [nm RMS]")
    limit_failures: float = Field(
        0.1, ge=0, le=1, description="largest part of failures at the limiting magnitude"
    )

    noise: Literal["reads", "recorded"] = Field(
        "reads",
        description="noise of the dimmed frames: of all the reads of an exposure, with sky and dark current; "
        "or as the frames were recorded, which in simulations may be one read without sky",
    )

    @field_validator("modes")
    @classmethod
    def _focus_among_them(cls, modes: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, ...], ...]:
        if any(4 not in one for one in modes):
            raise ValueError("every set of modes must hold 4 (defocus)")
        return modes
