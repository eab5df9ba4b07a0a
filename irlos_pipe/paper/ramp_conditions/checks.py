"""What the results of the experiment `ramp_conditions` have to keep."""

from __future__ import annotations

import math

from irlos_pipe.paper.ramp_conditions.results import RampConditionsResults, WayRow
from irlos_pipe.product.product import Check


def checks_of(results: RampConditionsResults) -> list[Check]:
    """Return the checks of the `results`: the error of the defocus, where a limit is asked."""
    return [_error(row) for row in results.rows if math.isfinite(row.asked_nm)]


def _error(row: WayRow) -> Check:
    error = row.true_rms_nm
    return Check(
        f"defocus error, ramp with {row.condition_label}",
        error.value,
        "nm",
        None,
        row.asked_nm,
        f"{error.value:.1f} nm RMS (90 %: {error.low:.1f} to {error.high:.1f}), asked {row.asked_nm:g} nm",
    )
