"""Results of stage `derotator`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import ByNoll, Number, ResultsPart, StageResults
from irlos_pipe.stages.calibrate.results import AngleRow


class PartRow(ResultsPart):
    """One part of the wavefront.

    Attributes
    ----------
    rms_nm, noise_nm : float
        RMS over the disc, and what of it the errors of the estimates explain.
    zernike_nm, sigma_nm : dict of int to float
        Modes of the part, and their standard errors [nm RMS].
    """

    rms_nm: Number = math.nan
    noise_nm: Number = math.nan
    zernike_nm: ByNoll = {}
    sigma_nm: ByNoll = {}


class ConsistencyRow(ResultsPart):
    """Mean RMS difference between two angles, see `estimate.derotator.Consistency`.

    Attributes
    ----------
    measured_nm : float
        As measured: small if nothing turned.
    turned_back_nm : float
        In the frame before the derotator: small if everything turned.
    without_fixed_nm : float
        The same after the fixed part is taken out: small if the split explains all.
    expected_nm : float
        From the errors of the estimates alone.
    """

    measured_nm: Number = math.nan
    turned_back_nm: Number = math.nan
    without_fixed_nm: Number = math.nan
    expected_nm: Number = math.nan


class SplitRow(ResultsPart):
    """A series of derotator angles split into parts.

    Attributes
    ----------
    modes : list of int
        Noll indices of the modes that were split.
    reason : str or None
        Why nothing could be split.
    sense : str
        ``clockwise`` or ``anticlockwise``: how the rotating part turns with the angle.
    delta_chi2 : float
        χ² of the other sense minus that of this one.
    chi2_nu, freedom : float, int
        Reduced χ² of the parts against the single estimates, and its degrees of freedom.
    parts : dict of str to PartRow or None
        ``rotating`` (as at angle 0), ``fixed`` and ``unsplit``; None where nothing could be split.
    measured_nm, residual_nm : list of float
        RMS of every estimate, and of what the parts leave of it.
    """

    modes: list[int] = []
    reason: str | None = None
    sense: str = ""
    delta_chi2: Number = math.nan
    chi2_nu: Number = math.nan
    freedom: int = 0
    parts: dict[str, PartRow] | None = None
    consistency: ConsistencyRow = ConsistencyRow()
    measured_nm: list[Number] = []
    residual_nm: list[Number] = []


class DerotatorResults(SplitRow, StageResults):
    """The split of the estimates of all `cubes`."""

    stage: ClassVar[str] = "derotator"
    cubes: list[AngleRow] = []
