"""Random NCPAs of IRLOS."""

from __future__ import annotations

import numpy as np


def draw_ncpa_nm(rng: np.random.Generator, total_nm: float = 142.0, modes: int = 50) -> dict[int, float]:
    """Draw static aberrations from Noll 2 on, Noll: nm RMS.

    The standard deviations follow ``70 exp(-0.2 i) + 10`` nm, i = 0 for Noll 2 (the law of the
    published LIFT/DIP experiments); tip and tilt share that of Noll 2. Each draw is scaled to
    `total_nm`, the root of the sum of squares.
    """
    order = np.arange(modes)
    order[1:2] = 0
    drawn_nm = (70 * np.exp(-0.2 * order) + 10) * rng.standard_normal(modes)
    return dict(enumerate((drawn_nm * total_nm / np.linalg.norm(drawn_nm)).tolist(), start=2))
