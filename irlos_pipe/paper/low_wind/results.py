"""Results of the experiment `low_wind`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.product.results import Number, ResultsPart, StageResults


class LowWindRow(ResultsPart):
    """Cubes of one kind and one size of the effect, by the same model; medians and spreads over the samples.

    Attributes
    ----------
    recording : str
        Band and exposure.
    size_nm : float
        Of the pistons [nm RMS over the petals].
    largest_difference_nm : Percentiles
        Largest difference of the pistons of two petals.
    introduced_nm : Percentiles
        RMS over the pupil of the wavefront that is to be found, NCPAs and petals together.
    model : {"without", "with"}
        Whether piston, tip and tilt of the petals are in the model.
    pupil_nm, folded_nm : Percentiles
        RMS over the pupil of what is left of the wavefront, as it is, and where every petal may be whole
        waves of H off.
    modes_nm : Percentiles
        The same in Noll 2–30.
    chi2_nu : Percentiles
    asked_nm : float
        Limit of all samples in `folded_nm` (one band) or `pupil_nm` (two); NaN where there is none.
    worst_nm : float
        The largest of these over the samples.
    """

    recording: str = ""
    size_nm: Number = math.nan
    largest_difference_nm: Percentiles = Percentiles()
    introduced_nm: Percentiles = Percentiles()
    model: str = ""
    pupil_nm: Percentiles = Percentiles()
    folded_nm: Percentiles = Percentiles()
    modes_nm: Percentiles = Percentiles()
    chi2_nu: Percentiles = Percentiles()
    asked_nm: Number = math.nan
    worst_nm: Number = math.nan


class LowWindResults(StageResults):
    """How large a low-wind effect a calibration stands."""

    stage: ClassVar[str] = "low_wind"
    samples: int = 0
    rows: list[LowWindRow] = []
