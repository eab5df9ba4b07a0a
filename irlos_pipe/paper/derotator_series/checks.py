"""What the results of the experiment `derotator_series` have to keep."""

from __future__ import annotations

import math

from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.derotator_series.results import DerotatorSeriesResults, MethodRow
from irlos_pipe.product.product import Check

LARGEST_PULL = 1.5  # error over quoted error


def checks_of(results: DerotatorSeriesResults) -> list[Check]:
    """Return the checks of the `results`: the default's parts err as quoted."""
    if DEFAULT not in results.methods:
        return []
    row = results.methods[DEFAULT]
    return [_pull(row, "rotating", row.errors.rotating_nm), _pull(row, "fixed", row.errors.fixed_nm)]


def _pull(row: MethodRow, part: str, error_nm: float) -> Check:
    parts = row.parts or {}
    sigma_nm = parts[part].sigma_nm if part in parts else {}
    quoted_nm = math.hypot(*(sigma_nm[noll] for noll in sigma_nm if noll <= HIGHEST_REPORTED_NOLL))
    return Check(
        f"error over quoted error, {part} part",
        error_nm / quoted_nm if quoted_nm > 0 else math.nan,
        "",
        None,
        LARGEST_PULL,
        f"{error_nm:.1f} nm where {quoted_nm:.1f} are quoted, Noll 4 to {HIGHEST_REPORTED_NOLL}",
    )
