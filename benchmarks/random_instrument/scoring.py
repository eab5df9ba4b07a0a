"""How far off a calibration is, and whether it says so."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from irlos_pipe.conventions.modes import DEFOCUS, REPORTED_NOLLS, TIP_TILT

BAD_NM, BAD_PULL = 12.0, 3.0  # an error, and an RMS pull, above which nobody should use a calibration
SHAPES = tuple(noll for noll in REPORTED_NOLLS if noll not in TIP_TILT)


@dataclass(frozen=True)
class Judged:
    """One calibration against the truth.

    Attributes
    ----------
    error_nm : float
        RMS of Noll 2–30 against the mean wavefront of the frames, which is all that the images have beyond
        the diversity as told [nm].
    shape_nm : float
        The same of Noll 4–30, without the star's place [nm].
    strict_nm : float
        The same of Noll 2–30 where the error of the diversity counts as one of the calibration [nm].
    defocus_nm : float
        Error of Noll 4 [nm].
    pulls : ndarray, (27,)
        Errors of Noll 4–30 against the static wavefront, over the quoted ones.
    red : bool
        Whether the run said that its result may not be used.
    """

    error_nm: float
    shape_nm: float
    strict_nm: float
    defocus_nm: float
    pulls: np.ndarray
    red: bool

    @property
    def pull(self) -> float:
        """RMS pull of the modes."""
        return float(np.sqrt(np.mean(self.pulls**2)))

    @property
    def bad(self) -> bool:
        """Whether nobody should use the result."""
        return self.error_nm > BAD_NM or self.pull > BAD_PULL


def judged(outcome: Mapping[str, Any], which: str) -> Judged:
    """Judge the calibration `which` of an `outcome`, ``plain`` or ``diagnosed``."""
    found, truth = outcome[which], outcome["truth"]
    error_nm, static_error_nm = (
        {noll: found["zernike_nm"][str(noll)] - truth[name].get(str(noll), 0.0) for noll in REPORTED_NOLLS}
        for name in ("mean_nm", "static_nm")
    )
    missed_nm = truth["diversity_error_nm"]
    return Judged(
        _norm(error_nm.values()),
        _norm(error_nm[noll] for noll in SHAPES),
        _norm(error + missed_nm.get(str(noll), 0.0) for noll, error in error_nm.items()),
        error_nm[DEFOCUS],
        np.array([static_error_nm[noll] / found["sigma_nm"][str(noll)] for noll in SHAPES]),
        found["exit_code"] != 0,
    )


def _norm(values: Iterable[float]) -> float:
    return float(np.linalg.norm(list(values)))
