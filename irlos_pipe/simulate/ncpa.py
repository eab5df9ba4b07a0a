"""Random NCPAs."""

from __future__ import annotations

import numpy as np

from irlos_pipe.conventions.laws import NcpaLaw


def draw_ncpa_nm(
    rng: np.random.Generator, law: NcpaLaw, total_nm: float, modes: int = 50
) -> dict[int, float]:
    """Draw static aberrations from Noll 2 on, Noll: nm RMS.

    Parameters
    ----------
    rng : numpy.random.Generator
    law : NcpaLaw
        Standard deviations before scaling; tip and tilt share that of Noll 2.
    total_nm : float
        Root of the sum of squares that every draw is scaled to [nm RMS].
    modes : int
        Number of modes.
    """
    nolls = np.arange(2, modes + 2)
    nolls[1:2] = 2
    drawn_nm = law.sigma_nm(nolls) * rng.standard_normal(modes)
    return dict(enumerate((drawn_nm * total_nm / np.linalg.norm(drawn_nm)).tolist(), start=2))


def draw_tail_nm(
    rng: np.random.Generator, rms_nm: float, first_noll: int, last_noll: int
) -> dict[int, float]:
    """Draw modes of equal standard deviation, as fine as the polish of the optics leaves them.

    Parameters
    ----------
    rng : numpy.random.Generator
    rms_nm : float
        Standard deviation of every mode [nm RMS].
    first_noll, last_noll : int

    Returns
    -------
    dict of int to float
        Noll: nm RMS.
    """
    values_nm = rms_nm * rng.standard_normal(last_noll + 1 - first_noll)
    return dict(enumerate(values_nm.tolist(), start=first_noll))
