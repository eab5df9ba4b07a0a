"""Results of the experiment `methods`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from irlos_pipe.paper.common.results import ONE_SIGMA, Interval
from irlos_pipe.product.results import Number, ResultsPart, StageResults


class Distribution(ResultsPart):
    """Δ-WFE of one variant over the samples of one condition [nm RMS].

    Attributes
    ----------
    low_nm, high_nm : float
        Range in which the median lies, 90 %, by bootstrap over the samples.
    p16_nm, p84_nm, worst_nm : float
        Scatter of the samples.
    """

    median_nm: Number = math.nan
    low_nm: Number = math.nan
    high_nm: Number = math.nan
    p16_nm: Number = math.nan
    p84_nm: Number = math.nan
    worst_nm: Number = math.nan
    samples: int = 0

    @classmethod
    def of(cls, values_nm: Sequence[float] | np.ndarray) -> Distribution:
        """Return the percentiles of a list of values."""
        p16, median, p84 = map(float, np.percentile(values_nm, ONE_SIGMA))
        between = Interval.of_median(values_nm)
        return cls(
            median_nm=median,
            low_nm=between.low,
            high_nm=between.high,
            p16_nm=p16,
            p84_nm=p84,
            worst_nm=float(np.max(values_nm)),
            samples=len(values_nm),
        )


class ConditionRow(ResultsPart):
    """All cubes of one seeing and one shape of the AO residual.

    Attributes
    ----------
    introduced_nm, introduced_scatter_nm : float
        Mean and standard deviation over the cubes of the introduced wavefront [nm RMS].
    modes, pupil : dict of str to Distribution
        Δ-WFE in Noll 2–30 and over the full pupil, by variant.
    ratio_to_dip_global : float
        Median error of the default over that of the paper's choice.
    parts : dict of str to Distribution
        Δ-WFE in Noll 2–30 with parts of the default changed, on the cubes where all were tried; empty
        where none were, and so are the following.
    chi2_nu : dict of str to float
        Median χ²/ν of the mean image.
    speckle_floor_nm, beside_floor_nm : float
        Error from the finite number of speckles in a cube, and the rest of the default's error.
    """

    shape: str = ""
    seeing_arcsec: Number = math.nan
    samples: int = 0
    introduced_nm: Number = math.nan
    introduced_scatter_nm: Number = math.nan
    modes: dict[str, Distribution] = {}
    pupil: dict[str, Distribution] = {}
    ratio_to_dip_global: Number = math.nan
    parts: dict[str, Distribution] = {}
    chi2_nu: dict[str, Number] = {}
    speckle_floor_nm: Number = math.nan
    beside_floor_nm: Number = math.nan


class MethodsResults(StageResults):
    """Calibration methods compared; `labels` says what every variant is."""

    stage: ClassVar[str] = "methods"
    conditions: list[ConditionRow] = []
    labels: dict[str, str] = {}
