"""`ghost`: a displaced image that the optics make of all light, out of focus and blurred."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.simulate.effects.base import LightEffect
from irlos_pipe.simulate.light import Ray

NODES = 6  # per axis of the Gauss-Hermite rule of the blur


@dataclass(frozen=True)
class Ghost(LightEffect):
    """All light again, at `sep_mas` towards `pa_deg`, `defocus_nm` out of focus and blurred."""

    name = "ghost"
    flux_ratio: float
    sep_mas: float
    pa_deg: float
    defocus_nm: float = 0.0
    blur_mas: float = 0.0

    def rays(self, rays: list[Ray]) -> list[Ray]:
        """See `LightEffect.rays`."""
        return rays + [image for ray in rays for image in self._images(ray)]

    def _images(self, ray: Ray) -> list[Ray]:
        """Images of a ray, of which the ghost consists."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(NODES if self.blur_mas else 1)
        shares = weights / weights.sum()
        middle = replace(ray.moved(self.sep_mas, self.pa_deg), defocus_nm=ray.defocus_nm + self.defocus_nm)
        return [
            replace(
                middle.moved(self.blur_mas * float(x), 0.0).moved(self.blur_mas * float(y), 90.0),
                weight=ray.weight * self.flux_ratio * float(along_x * along_y),
            )
            for x, along_x in zip(nodes, shares, strict=True)
            for y, along_y in zip(nodes, shares, strict=True)
        ]
