"""Quality control of stage `diagnose`: what is left unexplained needs a look."""

from __future__ import annotations

import math
from collections.abc import Sequence

from irlos_pipe.diagnosis.verdict import UNKNOWN
from irlos_pipe.product.product import Check
from irlos_pipe.stages.calibrate.quality import kinds_check
from irlos_pipe.stages.diagnose.results import DiagnoseResults


def checks_of(results: DiagnoseResults, kurtosis: Sequence[float] = ()) -> list[Check]:
    """Return the checks of a diagnosis: that the model with what was named lacks nothing, and of its frames.

    Parameters
    ----------
    results : DiagnoseResults
    kurtosis : sequence of float
        Of the frames of every recording, see `estimate.frame_kinds`; NaN where it tells nothing.
    """
    explained = results.verdict != UNKNOWN and not results.unexplained
    grade = f", {results.grade}" if results.grade and results.grade != results.verdict else ""
    message = f"{results.verdict}{grade}: {results.sentence}"
    found = [kinds_check(one) for one in kurtosis if math.isfinite(one)]
    return [Check("everything explained", float(explained), "", 1.0, None, message), *found]
