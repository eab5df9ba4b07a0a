"""Results of the experiment `first_tests`."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from irlos_pipe.product.results import Number, ResultsPart, StageResults


class VariantRow(ResultsPart):
    """One variant of LIFT on one target; lists have one entry per ramp.

    Attributes
    ----------
    key : str
        Of `variants_of`.
    modes : list of int
        Noll.
    slope, rms_nm, line_rms_nm, converged : list of float
        See `TargetErrors`.
    kernel_mas : list of float
        Kernel of object and jitter that was used.
    stage_true_nm : float
        Simulated error of the focus stage.
    stage_found_nm, stage_sigma_nm : list of float
        Error of the focus stage as found from the commanded defocus, and its standard error.
    """

    key: str = ""
    label: str = ""
    modes: list[int] = []
    slope: list[Number] = []
    rms_nm: list[Number] = []
    line_rms_nm: list[Number] = []
    converged: list[Number] = []
    kernel_mas: list[Number] = []
    stage_true_nm: Number = math.nan
    stage_found_nm: list[Number] = []
    stage_sigma_nm: list[Number] = []

    @property
    def pull(self) -> float:
        """Return the RMS over the ramps of (found − true) / error, of the focus stage's error."""
        deviations = np.array(self.stage_found_nm) - self.stage_true_nm
        return float(np.sqrt(np.mean((deviations / np.array(self.stage_sigma_nm)) ** 2)))


class StartRow(ResultsPart):
    """LIFT of the frames of all ramps from one start.

    Attributes
    ----------
    way : str
        Key of the variant.
    start : str
        Of `STARTS`.
    wrong : int
        Frames that did not converge or ended far from the best minimum.
    median_iterations : float
    """

    way: str = ""
    start: str = ""
    frames: int = 0
    wrong: int = 0
    median_iterations: Number = math.nan


class TargetRow(ResultsPart):
    """One target.

    Attributes
    ----------
    seeing_arcsec, sparta_seeing_arcsec : float
        By MASS-DIMM, and on SPARTA's scale.
    samples : int
        Ramps.
    frames : list of int
        Of every ramp.
    stage_error : str
        ``saw_tooth`` or ``second_run_bias``.
    ways : list of VariantRow
        Variants of LIFT.
    starts : list of StartRow
    """

    key: str = ""
    label: str = ""
    mag_j: Number = math.nan
    seeing_arcsec: Number = math.nan
    sparta_seeing_arcsec: Number = math.nan
    samples: int = 0
    frames: list[int] = []
    stage_error: str = ""
    ways: list[VariantRow] = []
    starts: list[StartRow] = []

    def variant(self, key: str) -> VariantRow:
        """Return the variant of a key."""
        return next(one for one in self.ways if one.key == key)


class FirstTestsResults(StageResults):
    """The first test on sky, simulated."""

    stage: ClassVar[str] = "first_tests"
    targets: list[TargetRow] = []
