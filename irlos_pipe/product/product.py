"""The product of a stage: arrays with units and errors, results, QC, configuration, provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Quantity:
    """An array with its unit.

    Attributes
    ----------
    value : ndarray
        Numbers, booleans or strings, of any shape (scalars included).
    unit : str
        Unit as text, for example ``nm``; empty for dimensionless values and strings.
    error : ndarray or None
        1-sigma error in the same unit and of the same shape.

    Raises
    ------
    ValueError
        When value and error differ in shape.
    """

    value: np.ndarray
    unit: str
    description: str = ""
    error: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.error is not None and np.shape(self.error) != np.shape(self.value):
            raise ValueError(f"error has shape {np.shape(self.error)}, value {np.shape(self.value)}")


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
