"""What a mirror leaves of a wavefront, and what it would leave if the wavefront were told to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.modes import CORRECTED_NOLLS, HIGHEST_REPORTED_NOLL, TIP_TILT
from irlos_pipe.simulate.mirror import Mirror
from irlos_pipe.simulate.telescope import Telescope

LAST_FITTED = 66  # so that modes beyond the corrected ones do not pass for them


@dataclass(frozen=True)
class Left:
    """RMS over the pupil of parts of a wavefront, without piston, tip and tilt [nm].

    Attributes
    ----------
    modes_nm, beyond_nm, all_nm : float
        In Noll 4–30, in all that these are not, and of both together.
    """

    modes_nm: float
    beyond_nm: float
    all_nm: float


@dataclass(frozen=True, eq=False)
class Judge:
    """Looks at wavefronts on the pupil of the simulator.

    Attributes
    ----------
    telescope : Telescope
    """

    telescope: Telescope

    def coefficients_nm(self, opd_nm: np.ndarray) -> dict[int, float]:
        """Return Noll 2..30 of a wavefront `opd_nm`, (n, n), fitted beside modes beyond: nm RMS."""
        fitted_nm = self.telescope.fit_zernike_nm(opd_nm, LAST_FITTED)[: HIGHEST_REPORTED_NOLL - 1]
        return dict(enumerate(fitted_nm.tolist(), start=2))

    def left(self, opd_nm: np.ndarray) -> Left:
        """Return what there is in a wavefront `opd_nm`, (n, n) [nm]."""
        found_nm = self.coefficients_nm(opd_nm)
        modes_nm = self.telescope.opd_nm({noll: found_nm[noll] for noll in CORRECTED_NOLLS})
        still_nm = opd_nm - self.telescope.opd_nm({noll: found_nm[noll] for noll in TIP_TILT})
        parts = (modes_nm, still_nm - modes_nm, still_nm)
        return Left(*(self._rms_nm(part) for part in parts))

    def _rms_nm(self, opd_nm: np.ndarray) -> float:
        weight = self.telescope.transmission
        mean_nm = np.average(opd_nm, weights=weight)
        return float(np.sqrt(np.average((opd_nm - mean_nm) ** 2, weights=weight)))


def further(offsets_nm: Mapping[int, float], seen_nm: Mapping[int, float]) -> dict[int, float]:
    """Return the offsets of Noll 4..30 after one more estimate; tip and tilt stay.

    Parameters
    ----------
    offsets_nm, seen_nm : mapping of int to float
        Offsets so far, and the estimate, Noll: nm RMS.
    """
    return {noll: offsets_nm.get(noll, 0.0) - seen_nm.get(noll, 0.0) for noll in CORRECTED_NOLLS}


def told(
    judge: Judge, mirror: Mirror, opd_nm: np.ndarray, unseen_nm: np.ndarray | float, corrections: int
) -> list[np.ndarray]:
    """Return the wavefronts that a mirror leaves when every estimate is the truth.

    Parameters
    ----------
    judge : Judge
    mirror : Mirror
        With the offsets that it starts with.
    opd_nm : ndarray, (n, n)
        Wavefront without the mirror.
    unseen_nm : ndarray, (n, n), or 0
        In the cubes that the estimates are made of, but not in the wavefront: the error of the diversity.
    corrections : int

    Returns
    -------
    list of ndarray, (n, n)
        Before the first correction and after each.
    """
    states = [opd_nm + mirror.opd_nm(judge.telescope)]
    for _ in range(corrections):
        offsets_nm = further(mirror.offsets_nm, judge.coefficients_nm(states[-1] + unseen_nm))
        mirror = replace(mirror, offsets_nm=offsets_nm)
        states.append(opd_nm + mirror.opd_nm(judge.telescope))
    return states


def diversity_error_nm(telescope: Telescope, mirror: Mirror, diversity_nm: Mapping[int, float]) -> np.ndarray:
    """Return by how much the diversity that a `mirror` makes differs from the one declared, (n, n) [nm].

    Parameters
    ----------
    telescope : Telescope
    mirror : Mirror
        Its offsets do not count.
    diversity_nm : mapping of int to float
        As declared, Noll: nm RMS.
    """
    made_nm = replace(mirror, offsets_nm=diversity_nm).opd_nm(telescope)
    return made_nm - telescope.opd_nm(diversity_nm)
