"""The Zernike modes that results report: Noll 2 to 30, the 29 modal offsets that SPARTA takes."""

from __future__ import annotations

HIGHEST_REPORTED_NOLL = 30
REPORTED_NOLLS = tuple(range(2, HIGHEST_REPORTED_NOLL + 1))
REPORTED_TEXT = f"Noll {REPORTED_NOLLS[0]}–{HIGHEST_REPORTED_NOLL}"
