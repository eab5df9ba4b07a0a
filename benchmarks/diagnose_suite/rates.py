"""Rates with their intervals."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from scipy.stats import binomtest

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Rate:
    """How often something happened.

    Attributes
    ----------
    count, total : int
    low, high : float
        Clopper–Pearson interval of 95 % for the probability.
    """

    count: int
    total: int
    low: float
    high: float

    @classmethod
    def of(cls, happened: Iterable[bool]) -> Rate:
        """Of a series of events; without any the interval is everything."""
        events = [bool(one) for one in happened]
        if not events:
            return cls(0, 0, 0.0, 1.0)
        interval = binomtest(sum(events), len(events)).proportion_ci(CONFIDENCE, method="exact")
        return cls(sum(events), len(events), float(interval.low), float(interval.high))

    @property
    def value(self) -> float:
        """The rate; NaN without events."""
        return self.count / self.total if self.total else float("nan")

    @property
    def text(self) -> str:
        """For tables."""
        if not self.total:
            return "-"
        return f"{self.count}/{self.total} = {self.value:.1%} ({self.low:.1%} to {self.high:.1%})"

    def as_json(self) -> dict[str, Any]:
        """For scripts."""
        return asdict(self) | {"value": self.value}
