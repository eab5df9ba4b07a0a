"""The product of a stage: arrays with units and errors, results, QC, configuration, provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from irlos_pipe.conventions.text import aligned
from irlos_pipe.product.quantity import Quantity
from irlos_pipe.product.table_view import table_of

if TYPE_CHECKING:
    from astropy.table import QTable

SHOWN = 12  # arrays of a product, in its text


@dataclass(frozen=True)
class Check:
    """One quality-control check: a value and the limits it must keep."""

    name: str
    value: float
    unit: str
    low: float | None
    high: float | None
    message: str

    @property
    def passed(self) -> bool:
        """True inside the limits; a NaN never passes."""
        above = self.low is None or self.value >= self.low
        below = self.high is None or self.value <= self.high
        return bool(above and below and not np.isnan(self.value))

    @property
    def limits(self) -> str:
        """The limits as text, empty if there are none."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g} … {self.high:g}"
        if self.low is not None:
            return f"≥ {self.low:g}"
        return f"≤ {self.high:g}" if self.high is not None else ""

    def as_dict(self) -> dict[str, Any]:
        """Return the check as it stands in qc.json."""
        return {
            "name": self.name,
            "passed": self.passed,
            "value": self.value,
            "unit": self.unit,
            "low": self.low,
            "high": self.high,
            "message": self.message,
        }


@dataclass(frozen=True)
class Product:
    """What one stage leaves behind.

    Attributes
    ----------
    arrays : mapping of str to Quantity
        Names may contain ``/``, which makes HDF5 groups.
    results : dict
        The stage's section of results.json.
    """

    stage: str
    arrays: Mapping[str, Quantity]
    results: dict[str, Any]
    checks: list[Check] = field(default_factory=list)
    config: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)

    @property
    def summary(self) -> list[str]:
        """What came out, in lines for people."""
        return list(self.provenance.get("summary", ()))

    def __getitem__(self, name: str) -> Quantity:
        """Return the array called `name`."""
        return self.arrays[name]

    def table(self, *names: str) -> QTable:
        """Return arrays of equal length as an `astropy.table.QTable` with units.

        Parameters
        ----------
        *names : str
            By default all arrays of one dimension that have the length of the first of them. An error
            becomes the column ``<name>_error``.

        Raises
        ------
        ConfigurationError
            When an array is unknown, or the lengths differ.
        """
        return table_of(self.stage, self.arrays, names)

    def __repr__(self) -> str:
        """Return what came out and what the product holds, in lines."""
        passed = sum(check.passed for check in self.checks)
        head = f"Product of '{self.stage}': {passed} of {len(self.checks)} checks passed"
        names = list(self.arrays)
        rows = [(f"  {name}", *self.arrays[name].described) for name in names[:SHOWN]]
        more = [f"  … and {len(names) - SHOWN} more arrays"] if len(names) > SHOWN else []
        return "\n".join([head, *(f"  {line}" for line in self.summary), aligned(rows), *more])
