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


def rounded_by_error(value: float, error: float | None) -> str:
    """Format ``value ± error`` to the second digit of the error; four digits without an error."""
    if MISSING in (number(value), number(error)) or error <= 0:
        return number(value, ".4g")
    decimals = 1 - math.floor(math.log10(error))
    value, error = (round(one, decimals) for one in (value, error))
    return f"{value:.{max(decimals, 0)}f} ± {error:.{max(decimals, 0)}f}"


def plural(count: int, noun: str) -> str:
    """Format a count with its noun: ``1 frame``, ``2 frames``."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def duration(seconds: float | None) -> str:
    """Format a time to two units: ``4.2 s``, ``3 min 20 s``, ``2 h 05 min``."""
    if number(seconds) == MISSING:
        return MISSING
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
