"""`seeing_halo`: an AO residual of another size."""

from __future__ import annotations

from dataclasses import dataclass

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.effects.base import SkyEffect
from irlos_pipe.simulate.errors import SceneError


@dataclass(frozen=True)
class SeeingHalo(SkyEffect):
    """The residual is larger by the factor `scale`, or `wfe_nm` in total, its spectrum of the same shape.

    On the bench there is none to enlarge: the factor then is one on the residual at the facility's typical
    seeing.
    """

    name = "seeing_halo"
    scale: float | None = None
    wfe_nm: float | None = None

    def __post_init__(self) -> None:
        if (self.scale is None) == (self.wfe_nm is None):
            raise SceneError("effects.seeing_halo: give either scale or wfe_nm")

    def sky(self, sky: Sky | None, facility: Facility) -> Sky | None:
        """See `SkyEffect.sky`."""
        sky, law = sky or Sky(facility.typical_seeing_arcsec), facility.residual_law
        factor = self.scale if self.wfe_nm is None else self.wfe_nm / sky.total_nm(law)
        return sky.scaled(factor, law) if factor else None
