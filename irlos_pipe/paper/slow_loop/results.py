"""Results of the experiment `slow_loop`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.control.disturbance import Drift
from irlos_pipe.paper.slow_loop.outcome import LoopOutcome
from irlos_pipe.product.results import Number, StageResults


class LoopRow(LoopOutcome):
    """One loop: its settings, see `Loop`, its statistics, and what linear theory expects.

    Attributes
    ----------
    bound_nm : float
        Cramér–Rao bound of a measurement [nm RMS].
    expected_noise_nm : float
        Noise of a measurement by photons and detector, with the AO residual's own defocus.
    predicted_nm : float
        Residual by linear theory with this noise.
    best_gain : float
        Gain of the smallest predicted residual.
    gain_margin : float
        Factor by which the gain could grow before the loop oscillates.
    """

    sensor: str = ""
    mag_j: Number = math.nan
    gain: Number = math.nan
    exposures: int = 1
    bound_nm: Number = math.nan
    expected_noise_nm: Number = math.nan
    predicted_nm: Number = math.nan
    best_gain: Number = math.nan
    gain_margin: Number = math.nan


class SlowLoopResults(StageResults):
    """The slow focus loop closed on LIFT.

    Attributes
    ----------
    sky_focus_nm : float
        Defocus of the AO residual in a frame [nm RMS].
    open_loop_nm : float
        RMS defocus without a loop.
    default : str
        The default calibration method.
    delay : int
        Frames between exposure and correction.
    """

    stage: ClassVar[str] = "slow_loop"
    drift: Drift = Drift(math.nan, math.nan)
    sky_focus_nm: Number = math.nan
    open_loop_nm: Number = math.nan
    largest_stable_gain: Number = math.nan
    default: str = ""
    delay: int = 0
    loops: list[LoopRow] = []

    def best_loops(self, sensor: str, exposures: int = 1) -> list[LoopRow]:
        """Return the loops of one `sensor` and number of `exposures` at their best gain, brightest first.

        The best gain of a star is listed first.
        """
        first: dict[float, LoopRow] = {}
        for row in self.loops:
            if (row.sensor, row.exposures) == (sensor, exposures):
                first.setdefault(row.mag_j, row)
        return [first[mag_j] for mag_j in sorted(first)]

    def same_star(self, row: LoopRow) -> list[LoopRow]:
        """Return the loops on the star of `row` with its sensor and exposures, at every gain."""
        key = (row.sensor, row.exposures, row.mag_j)
        return [other for other in self.loops if (other.sensor, other.exposures, other.mag_j) == key]

    def scanned_stars(self) -> list[list[LoopRow]]:
        """Return the loops of every star tried at several gains: default calibration, frames of 1 s."""
        stars = [self.same_star(row) for row in self.best_loops(self.default)]
        return [rows for rows in stars if len(rows) > 1]
