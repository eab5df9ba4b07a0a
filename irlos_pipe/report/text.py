"""Numbers as text for people; what is missing becomes a dash."""

from __future__ import annotations

import math
from typing import Any

MISSING = "–"


def number(value: Any, pattern: str = ".1f", unit: str = "") -> str:
    """Format a number with its unit; None, NaN and infinity give a dash."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:{pattern}}" + (f" {unit}" if unit else "")


def with_error(value: Any, error: Any, pattern: str = ".1f", unit: str = "") -> str:
    """Format ``value ± error unit``; without an error the value alone."""
    if number(value) == MISSING or number(error) == MISSING:
        return number(value, pattern, unit)
    return f"{value:{pattern}} ± {error:{pattern.lstrip('+')}}" + (f" {unit}" if unit else "")


def plural(count: int, noun: str) -> str:
    """Format a count with its noun: ``1 frame``, ``2 frames``."""
    return f"{count} {noun}" + ("" if count == 1 else "s")
