"""Parts of the results that several experiments share."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from irlos_pipe.product.results import Number, ResultsPart

ONE_SIGMA = (15.87, 50.0, 84.13)  # percentiles of a normal distribution at -1σ, 0 and +1σ


class Percentiles(ResultsPart):
    """Median and one-sigma range of some values."""

    median: Number = math.nan
    p16: Number = math.nan
    p84: Number = math.nan

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray, ranks: Sequence[float] = ONE_SIGMA) -> Percentiles:
        """Return the percentiles of `values` at `ranks` [%]."""
        p16, median, p84 = map(float, np.percentile(values, ranks))
        return cls(median=median, p16=p16, p84=p84)
