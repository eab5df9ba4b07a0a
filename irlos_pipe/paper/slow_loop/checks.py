"""What the results of the experiment `slow_loop` have to keep."""

from __future__ import annotations

import math

from irlos_pipe.paper.slow_loop.results import SlowLoopResults
from irlos_pipe.paper.slow_loop.two_by_two import CENTROIDS
from irlos_pipe.product.product import Check

OVER_THEORY = 1.5


def checks_of(results: SlowLoopResults) -> list[Check]:
    """Return the checks of the `results`.

    The loop with the default calibration meets linear theory on the brightest star, and leaves no more than
    the centroids of the 2x2 mode on any star, which the paper expects of the full pupil.
    """
    default = results.best_loops(results.default)
    if not default:
        return []
    ratio = default[0].residual_nm / default[0].predicted_nm
    text = f"bright star: {ratio:.2f} of the prediction"
    checks = [Check("residual over prediction", ratio, "", None, OVER_THEORY, text)]
    held = {row.mag_j: row.residual_nm for row in results.best_loops(CENTROIDS) if row.diverged < row.runs}
    if held:
        pairs = [(row.residual_nm / held[row.mag_j], row.mag_j) for row in default if row.mag_j in held]
        worst, mag_j = max((math.inf if math.isnan(ratio) else ratio, mag_j) for ratio, mag_j in pairs)
        text = f"{worst:.2f} at m_J {mag_j:g}, where it is largest"
        checks.append(Check("residual over that of the 2x2 centroids", worst, "", None, 1.0, text))
    return checks
