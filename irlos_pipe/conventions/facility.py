"""Telescope, adaptive optics and site of an instrument: the facts that its profile states."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from irlos_pipe.conventions.keys import Limited, named_row
from irlos_pipe.conventions.laws import NcpaLaw, ResidualLaw
from irlos_pipe.conventions.pupil_drawing import PupilGeometry


@named_row
class VibrationLine(NamedTuple):
    """One vibration of the telescope."""

    hz: Annotated[float, Limited("frequency", gt=0, le=400)]
    share_x: Annotated[float, Limited("part of the variance along x", ge=0, le=1)]
    share_y: Annotated[float, Limited("part of the variance along y", ge=0, le=1)]


@dataclass(frozen=True)
class Facility:
    """What the model and the simulator know about telescope, adaptive optics and site."""

    pupil: PupilGeometry
    photons_per_s_m15: float  # through the whole aperture and sensor band at m_J = 15
    cutoff_per_m: float  # end of the AO correction band, 1 / (2 actuator pitch)
    outer_scale_m: float  # of the turbulence
    residual_law: ResidualLaw  # AO residual against seeing
    # standard deviation of the NCPAs: the simulator draws from it and the estimators take it as their prior
    ncpa_law: NcpaLaw
    typical_seeing_arcsec: float  # assumed where none was measured
    vibration_lines: tuple[VibrationLine, ...] = ()  # the slow wander has the rest of the variance
    numerical_aperture: float = 0.0  # NA / n of the beam in which the focus stage moves; 0 if not known
    # surface brightness of the sky in each band: wavelength [nm] of the band, mag
    sky_mag_per_arcsec2: tuple[tuple[float, float], ...] = ()

    def sky_photons_per_s(
        self, spectrum: Iterable[tuple[float, float]], photons_per_s_m0: float, pixel_scale_mas: float
    ) -> float:
        """Return the photons of the sky in a pixel [1/s]; 0 where its brightness is not known.

        Every wavelength has the brightness of the nearest band. The `spectrum` has (wavelength [nm], photon
        weight, any scale); `photons_per_s_m0` are those of a star of magnitude 0 through the same optics, for
        pixels of `pixel_scale_mas`.
        """
        if not self.sky_mag_per_arcsec2:
            return 0.0
        points = list(spectrum)
        brightness = sum(weight * 10 ** (-0.4 * self._sky_mag(nm)) for nm, weight in points)
        area_arcsec2 = (pixel_scale_mas / 1000) ** 2
        return photons_per_s_m0 * area_arcsec2 * brightness / sum(weight for _, weight in points)

    def _sky_mag(self, wavelength_nm: float) -> float:
        return min(self.sky_mag_per_arcsec2, key=lambda band: abs(band[0] - wavelength_nm))[1]
