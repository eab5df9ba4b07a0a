"""What effects have in common whose public value is a table {Noll index: coefficient}."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.declaration import Parameter


class ZernikeTable(Effect):
    """One parameter per mode; a base class beside that of the plane.

    Class attributes
    ----------------
    table : str
        Name of the public table.
    coefficient : Parameter
        Of one mode, except its name.
    """

    table: ClassVar[str]
    coefficient: ClassVar[Parameter]

    def __init__(self, nolls: Sequence[int]):
        self.nolls = tuple(int(noll) for noll in nolls)
        if len(set(self.nolls)) != len(self.nolls):
            raise ValueError(f"a Noll index occurs twice in {list(self.nolls)}")
        self.parameters = tuple(replace(self.coefficient, name=f"noll_{noll}") for noll in self.nolls)

    @classmethod
    def options_for(cls, **public: Any) -> dict[str, Any]:
        """The modes of the table."""
        return {"nolls": sorted(int(noll) for noll in public[cls.table])} if cls.table in public else {}

    def describe(self, values: np.ndarray) -> dict[str, dict[str, float]]:
        """Coefficients by Noll index."""
        return {self.table: {str(n): float(v) for n, v in zip(self.nolls, values, strict=True)}}

    @property
    def rms_name(self) -> str:
        """Name of the RMS of all modes together, with their unit."""
        return self.table.replace("zernike", "rms")

    def shown(self, values: np.ndarray) -> dict[str, Any]:
        """See `Effect.shown`."""
        return {self.rms_name: float(np.linalg.norm(values))} | self.describe(values)

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`; the size is the RMS of all modes together."""
        rms = float(np.linalg.norm(list(public[self.table].values())))
        return self.sentence.format(size=public.get(self.rms_name, rms))

    def values_of(self, *args: Any, **public: Mapping) -> list[float]:
        """Solver's parameters for a table of coefficients; modes that it lacks are 0."""
        given = {int(noll): float(value) for noll, value in public[self.table].items()}
        return [given.get(noll, 0.0) for noll in self.nolls]
