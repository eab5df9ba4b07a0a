"""`uneven_residual`: an AO residual that is stronger in some places of the pupil."""

from __future__ import annotations

from dataclasses import dataclass, replace

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.effects.base import SkyEffect


@dataclass(frozen=True)
class UnevenResidual(SkyEffect):
    """The variance inside the correction band has `edge`, `side_x` and `side_y` of Noll 4, 2 and 3.

    They are parts of the residual that there is; without one it is the residual at the typical seeing.
    """

    name = "uneven_residual"
    edge: float = 0.0
    side_x: float = 0.0
    side_y: float = 0.0

    def sky(self, sky: Sky | None, facility: Facility) -> Sky | None:
        """See `SkyEffect.sky`."""
        variance = {4: self.edge, 2: self.side_x, 3: self.side_y}
        return replace(sky or Sky(facility.typical_seeing_arcsec), variance_zernike=variance)
