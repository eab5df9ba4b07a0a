"""Random NCPAs."""

from __future__ import annotations

import numpy as np

from irlos_pipe.conventions.laws import NcpaLaw


def draw_ncpa_nm(
    rng: np.random.Generator, law: NcpaLaw, total_nm: float, modes: int = 50
) -> dict[int, float]:
    """Draw static aberrations of a number of `modes` from Noll 2 on, Noll: nm RMS.

    The `law` gives the standard deviations before scaling, tip and tilt sharing that of Noll 2; every draw
    from `rng` is scaled to `total_nm`, the root of the sum of squares.
    """
    nolls = np.arange(2, modes + 2)
    nolls[1:2] = 2
    drawn_nm = law.sigma_nm(nolls) * rng.standard_normal(modes)
    return dict(enumerate((drawn_nm * total_nm / np.linalg.norm(drawn_nm)).tolist(), start=2))


def draw_tail_nm(
    rng: np.random.Generator, rms_nm: float, first_noll: int, last_noll: int
) -> dict[int, float]:
    """Draw modes `first_noll` to `last_noll` of a standard deviation `rms_nm` from `rng`, Noll: nm RMS.

    They are as fine as the polish of the optics leaves them.
    """
    values_nm = rms_nm * rng.standard_normal(last_noll + 1 - first_noll)
    return dict(enumerate(values_nm.tolist(), start=first_noll))
