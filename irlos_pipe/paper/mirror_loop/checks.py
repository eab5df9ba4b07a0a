"""What the results of the experiment `mirror_loop` have to keep."""

from __future__ import annotations

import math

from irlos_pipe.paper.common.variants import DEFAULT
from irlos_pipe.paper.mirror_loop.results import LoopRow, MirrorLoopResults
from irlos_pipe.product.product import Check


def checks_of(results: MirrorLoopResults) -> list[Check]:
    """Return the checks of the `results`: the default's loops end, and leave no more than is asked."""
    ended = [_ended(row) for row in results.rows if row.method == DEFAULT]
    return ended + [_left(row) for row in results.rows if math.isfinite(row.asked_nm)]


def _ended(row: LoopRow) -> Check:
    return Check(
        f"loops cut off, {row.diversity} diversity, bias {row.bias_nm:g} nm",
        row.cut_off,
        "",
        None,
        0,
        f"loops in which the estimate still fell at the last correction that is allowed: {row.cut_off}",
    )


def _left(row: LoopRow) -> Check:
    return Check(
        f"Noll 4–30 left, bias {row.bias_nm:g} nm",
        row.worst_nm,
        "nm",
        None,
        row.asked_nm,
        f"{row.worst_nm:.1f} nm RMS in the worst sample, asked {row.asked_nm:g} nm",
    )
