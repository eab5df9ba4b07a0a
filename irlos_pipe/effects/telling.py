"""Public values of an effect, one number a row: tables and lists unrolled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def rows_of(public: Mapping[str, Any]) -> list[tuple[str, float]]:
    """Labels and numbers, such as ``("sigma_mas", 7.0)`` or ``("tip_nm 3", -20.0)``."""
    return [row for name, value in public.items() for row in _rows(name, value)]


def _rows(name: str, value: Any) -> list[tuple[str, float]]:
    if isinstance(value, Mapping):
        return [row for key, one in value.items() for row in _rows(f"{name} {key}", one)]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [row for place, one in enumerate(value, start=1) for row in _rows(f"{name} {place}", one)]
    return [(name, value)]
