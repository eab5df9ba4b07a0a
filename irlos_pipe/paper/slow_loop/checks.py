"""What the results of the experiment `slow_loop` have to keep."""

from __future__ import annotations

from irlos_pipe.paper.slow_loop.results import SlowLoopResults
from irlos_pipe.product.product import Check

OVER_THEORY = 1.5


def checks_of(results: SlowLoopResults) -> list[Check]:
    """Return the check of the `results`: the default's loop on the brightest star meets linear theory."""
    default = [row for row in results.loops if row.sensor == results.default]
    if not default:
        return []
    bright = min(default, key=lambda row: row.mag_j)
    ratio = bright.residual_nm / bright.predicted_nm
    text = f"bright star: {ratio:.2f} of the prediction"
    return [Check("residual over prediction", ratio, "", None, OVER_THEORY, text)]
