"""Results of the experiment `exposures`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.product.results import Number, ResultsPart, StageResults


class MethodRow(ResultsPart):
    """One method at one seeing.

    Attributes
    ----------
    method, label : str
        Key of `METHOD_NAMES`, and its name.
    modes_nm : list of Percentiles
        Δ-WFE in Noll 2–30 by exposure, over the cubes [nm RMS].
    best_s : float
        Exposure with the smallest median.
    """

    seeing_arcsec: Number = math.nan
    method: str = ""
    label: str = ""
    modes_nm: list[Percentiles] = []
    best_s: Number = math.nan


class ExposuresResults(StageResults):
    """Calibration methods against the length of an exposure, with the same light.

    Attributes
    ----------
    cubes : int
        At each seeing.
    exposures_s : list of float
    total_s : float
        Of every cube.
    """

    stage: ClassVar[str] = "exposures"
    cubes: int = 0
    exposures_s: list[Number] = []
    total_s: Number = math.nan
    rows: list[MethodRow] = []
