"""Noll indices: defocus, and the modes that results report, the 29 modal offsets that SPARTA takes."""

from __future__ import annotations

DEFOCUS = 4
HIGHEST_REPORTED_NOLL = 30
REPORTED_NOLLS = tuple(range(2, HIGHEST_REPORTED_NOLL + 1))
REPORTED_TEXT = f"Noll {REPORTED_NOLLS[0]}–{HIGHEST_REPORTED_NOLL}"
