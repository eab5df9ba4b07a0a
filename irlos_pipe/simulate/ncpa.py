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
