"""`companion`: a second source in the window."""

from __future__ import annotations

from dataclasses import dataclass, replace

from irlos_pipe.simulate.effects.base import LightEffect
from irlos_pipe.simulate.light import Ray


@dataclass(frozen=True)
class Companion(LightEffect):
    """Light of the star's spectrum in addition to the star's, at `sep_mas` towards `pa_deg`."""

    name = "companion"
    flux_ratio: float
    sep_mas: float
    pa_deg: float

    def rays(self, rays: list[Ray]) -> list[Ray]:
        """See `LightEffect.rays`."""
        moved = (ray.moved(self.sep_mas, self.pa_deg) for ray in rays)
        return rays + [replace(ray, weight=ray.weight * self.flux_ratio) for ray in moved]
