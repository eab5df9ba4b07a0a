"""What the results of the experiment `low_wind` have to keep."""

from __future__ import annotations

import math

from irlos_pipe.paper.low_wind.experiment import NARROW
from irlos_pipe.paper.low_wind.results import LowWindResults, LowWindRow
from irlos_pipe.product.product import Check


def checks_of(results: LowWindResults) -> list[Check]:
    """Return the checks of the `results`: what is left of the wavefront, where a limit is asked."""
    return [_left(row) for row in results.rows if math.isfinite(row.asked_nm)]


def _left(row: LowWindRow) -> Check:
    waves = ", whole waves of a petal apart" if row.recording.startswith(NARROW) else ""
    return Check(
        f"wavefront left with petals in the model, {row.recording}, {row.size_nm:g} nm",
        row.worst_nm,
        "nm",
        None,
        row.asked_nm,
        f"{row.worst_nm:.1f} nm RMS in the worst cube{waves}, asked {row.asked_nm:g} nm",
    )
