"""Settings of stage `modes`."""

from __future__ import annotations

from pydantic import Field, field_validator

from irlos_pipe.conventions.modes import HIGHEST_NOLL
from irlos_pipe.stages.base import StageConfig


class Config(StageConfig):
    """Settings of the mode statistics."""

    same_ncpas: bool = Field(
        False, description="whether the cubes have the same NCPAs, and so count as one draw of every mode"
    )
    law_highest_noll: int | None = Field(
        None,
        ge=7,
        le=HIGHEST_NOLL,
        description="highest Noll mode that the law is fitted to, from 4 on; null: all estimated modes",
    )
    numbers: tuple[int, ...] = Field(
        (21, 36, 45, 55, 66, 78, 91, 105), description="highest Noll modes to try"
    )
    cubes: int = Field(
        4, ge=0, description="number of cubes, from the first, that the numbers of modes are tried on"
    )

    @field_validator("numbers")
    @classmethod
    def _rising(cls, numbers: tuple[int, ...]) -> tuple[int, ...]:
        if (
            len(numbers) < 2
            or list(numbers) != sorted(set(numbers))
            or numbers[0] < 4
            or numbers[-1] > HIGHEST_NOLL
        ):
            raise ValueError(f"give at least two rising numbers between 4 and {HIGHEST_NOLL}")
        return numbers
