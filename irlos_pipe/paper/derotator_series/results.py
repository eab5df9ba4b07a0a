"""Results of the experiment `derotator_series`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults
from irlos_pipe.stages.derotator import SplitRow


class PartsWfe(ResultsPart):
    """RMS over the disc of the simulated parts, without tip and tilt [nm]."""

    rotating_nm: Number = math.nan
    fixed_nm: Number = math.nan


class SplitErrors(ResultsPart):
    """Errors of a split, RMS over the disc [nm].

    Attributes
    ----------
    rotating_nm, fixed_nm, unsplit_nm : float
        In Noll 4–30, among the modes of the part.
    rotating_all_nm : float
        Of the rotating part as a map: modes that were not estimated count in full.
    single_nm, model_nm : float
        Of the estimates at single angles, and of what the two parts predict for them, in Noll 4–30;
        the static wavefront is the truth.
    """

    rotating_nm: Number = math.nan
    fixed_nm: Number = math.nan
    unsplit_nm: Number = math.nan
    rotating_all_nm: Number = math.nan
    single_nm: Number = math.nan
    model_nm: Number = math.nan


class MethodRow(SplitRow):
    """The split of the estimates of one method, compared with the truth.

    Attributes
    ----------
    delta_nm, calibration_chi2_nu : list of float
        Δ-WFE in Noll 2–30 and χ²/ν of the estimate at every angle.
    """

    errors: SplitErrors = SplitErrors()
    delta_nm: list[Number] = []
    calibration_chi2_nu: list[Number] = []


class DerotatorSeriesResults(StageResults):
    """The derotator test on simulated cubes.

    Attributes
    ----------
    frames : dict of str to int
        Frames that every method was given.
    truth : PartsWfe
    methods : dict of str to MethodRow
    """

    stage: ClassVar[str] = "derotator_series"
    angles_deg: list[Number] = []
    frames: dict[str, int] = {}
    truth: PartsWfe = PartsWfe()
    methods: dict[str, MethodRow] = {}
