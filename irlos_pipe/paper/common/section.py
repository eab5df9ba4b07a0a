"""What the sections of several experiments share."""

from __future__ import annotations

import numpy as np

from irlos_pipe.report.run_data import RunData


def array_of(run: RunData, stage: str, name: str) -> np.ndarray:
    """Return the array `name` of the product of a `stage` of the `run`, which must be there."""
    return np.asarray(run.products[stage].arrays[name].value)
