"""Results of stage `sensitivity`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults


class CurveRow(ResultsPart):
    """One curve over the magnitudes `mag_j`.

    Attributes
    ----------
    calibrated : bool
        Whether the NCPAs are part of the known wavefront.
    modes : list of int
        Estimated modes (Noll).
    mag_j : list of float
        J magnitudes, to which the frames were dimmed.
    median_abs_error_nm, p16_nm, p84_nm : list of float
        Percentiles of |estimated − introduced| defocus.
    crb_nm, one_read_crb_nm : list of float
        Cramér–Rao bound, 1σ; and of exposures of one read without sky.
    failures : list of int
        Estimates that failed, of `trials` per magnitude.
    trials : int
        Estimates per magnitude.
    limit_mag : float
        Faintest magnitude that meets the criterion; NaN if none does.
    one_read_bound_mag : float
        Limiting magnitude of an efficient estimate from exposures of one read without sky.
    """

    calibrated: bool = False
    modes: list[int] = []
    mag_j: list[Number] = []
    median_abs_error_nm: list[Number] = []
    p16_nm: list[Number] = []
    p84_nm: list[Number] = []
    crb_nm: list[Number] = []
    one_read_crb_nm: list[Number] = []
    failures: list[int] = []
    trials: int | None = None
    limit_mag: Number = math.nan
    one_read_bound_mag: Number = math.nan

    @property
    def at_the_end(self) -> bool:
        """Whether the magnitudes end before the criterion is missed."""
        return bool(self.mag_j) and self.limit_mag == self.mag_j[-1]


class CriterionRow(ResultsPart):
    """What a limiting magnitude keeps: largest median error, and largest part of failures.

    Attributes
    ----------
    median_abs_error_nm : float
        Largest median of |estimated − introduced| defocus.
    failures : float
        Largest part of the estimates that may fail.
    """

    median_abs_error_nm: Number = math.nan
    failures: Number = math.nan


class NoiseRow(ResultsPart):
    """Noise of the dimmed frames, beside that of exposures of one read without sky.

    Attributes
    ----------
    reads : int
        Reads in an exposure.
    exposure_s : float
        Exposure of a frame.
    read_noise_e : float
        Read noise of one read.
    excess_noise_factor : float
        Variance of the photons over that of Poisson.
    sky_e, dark_e : float
        Electrons of sky and of dark current in a pixel of an exposure.
    floor_e2, one_read_floor_e2 : float
        Variance of a pixel without star.
    """

    reads: int | None = None
    exposure_s: Number = math.nan
    read_noise_e: Number = math.nan
    excess_noise_factor: Number = math.nan
    sky_e: Number = math.nan
    dark_e: Number = math.nan
    floor_e2: Number = math.nan
    one_read_floor_e2: Number = math.nan


class SensitivityResults(StageResults):
    """One curve per combination of modes and calibration.

    Attributes
    ----------
    crb_note : str
        How the Cramér–Rao bounds compare with the median errors.
    """

    stage: ClassVar[str] = "sensitivity"
    curves: list[CurveRow] = []
    criterion: CriterionRow = CriterionRow()
    noise: NoiseRow = NoiseRow()
    crb_note: str = ""
