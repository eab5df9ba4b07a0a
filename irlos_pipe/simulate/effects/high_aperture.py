"""Focus moved in a beam of high aperture: `high_aperture`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from irlos_pipe.simulate.effects.base import LensEffect
from irlos_pipe.simulate.telescope import Telescope


@dataclass(frozen=True)
class HighAperture(LensEffect):
    """The focus stage moves the focus where rays of the pupil's rim have the `sine`, NA / n."""

    name = "high_aperture"
    sine: float

    def defocus(self, telescope: Telescope) -> np.ndarray:
        """See `LensEffect.defocus`: the path ``1 - cos θ`` over its part of Noll 4."""
        s2 = self.sine**2
        if s2 == 0:
            return super().defocus(telescope)
        u = telescope.u_m * 2 / telescope.geometry.diameter_m
        cosine = np.sqrt(np.maximum(1 - s2 * (u[None, :] ** 2 + u[:, None] ** 2), 0))
        # ∫ sqrt(1 - s² t) dt and ∫ t sqrt(1 - s² t) dt over t = ρ² from 0 to 1
        q = np.sqrt(1 - s2)
        plain, first = 2 * (1 - q**3) / (3 * s2), (2 * (1 - q**3) / 3 - 2 * (1 - q**5) / 5) / s2**2
        return (plain - cosine) / (np.sqrt(3) * (plain - 2 * first))
