"""Effects on the smooth wavefront: further modes, errors of the diversity, bumps, drifts, colour, filters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from irlos_pipe.simulate.effects.base import RecordingSetup, WavefrontEffect, own, wider
from irlos_pipe.simulate.telescope import Telescope


@dataclass(frozen=True)
class HighOrderNcpa(WavefrontEffect):
    """Further static modes `zernike_nm`, Noll: nm RMS."""

    name = "high_order_ncpa"
    zernike_nm: Mapping[int, float] = wider(-1e4, 1e4)

    def static_zernike_nm(self, diversity_nm: Mapping[int, float]) -> Mapping[int, float]:
        """See `WavefrontEffect.static_zernike_nm`."""
        return self.zernike_nm


@dataclass(frozen=True)
class DiversityError(WavefrontEffect):
    """The amplitude of the diversity is larger than declared by `nm`."""

    name = "diversity_error"
    nm: float = wider(-1e4, 1e4)

    def misfit(self, setup: RecordingSetup) -> str:
        """See `SimulatedEffect.misfit`."""
        if any(setup.diversity_nm.values()):
            return ""
        return "effects.diversity_error needs a diversity; add the section 'diversity'"

    def static_zernike_nm(self, diversity_nm: Mapping[int, float]) -> Mapping[int, float]:
        """See `WavefrontEffect.static_zernike_nm`."""
        if self.nm == 0:
            return {}
        amplitude_nm = float(np.linalg.norm(list(diversity_nm.values())))
        return {noll: value_nm * self.nm / amplitude_nm for noll, value_nm in diversity_nm.items()}


@dataclass(frozen=True)
class PhaseBump(WavefrontEffect):
    """A Gaussian of height `nm` and standard deviation `width_m` at (`x_m`, `y_m`)."""

    name = "phase_bump"
    nm: float = wider(-1e4, 1e4)
    x_m: float = wider(-10.0, 10.0)
    y_m: float = wider(-10.0, 10.0)
    width_m: float = wider(1e-3, 10.0)

    def static_opd_nm(self, telescope: Telescope) -> np.ndarray:
        """See `WavefrontEffect.static_opd_nm`."""
        x2, y2 = (telescope.u_m - self.x_m) ** 2, (telescope.u_m - self.y_m) ** 2
        return self.nm * np.exp(-(x2[None, :] + y2[:, None]) / (2 * self.width_m**2))


@dataclass(frozen=True)
class NcpaDrift(WavefrontEffect):
    """Modes that grow linearly from nothing to `zernike_nm`, Noll: nm RMS, over the recording."""

    name = "ncpa_drift"
    zernike_nm: Mapping[int, float] = wider(-1e4, 1e4)

    def drift_zernike_nm(self) -> Mapping[int, float]:
        """See `WavefrontEffect.drift_zernike_nm`."""
        return self.zernike_nm


@dataclass(frozen=True)
class ChromaticNcpa(WavefrontEffect):
    """Modes that change in proportion to wavelength, Noll: nm RMS per µm.

    Attributes
    ----------
    reference_nm : float, optional
        Wavelength at which they vanish; the photon-weighted mean of the bands' centres by default.
    """

    name = "chromatic_ncpa"
    zernike_nm_per_um: Mapping[int, float] = wider(-1e4, 1e4)
    reference_nm: float | None = own("nm, where they vanish", 300.0, 5000.0)

    def chromatic_zernike_nm(self, wavelength_nm: float, mean_nm: float) -> Mapping[int, float]:
        """See `WavefrontEffect.chromatic_zernike_nm`."""
        distance_um = (wavelength_nm - (self.reference_nm or mean_nm)) / 1000
        return {noll: slope * distance_um for noll, slope in self.zernike_nm_per_um.items()}


@dataclass(frozen=True)
class FilterNcpa(WavefrontEffect):
    """The wavefront `zernike_nm` of the filter or lens of this recording, Noll: nm RMS."""

    name = "filter_ncpa"
    zernike_nm: Mapping[int, float] = wider(-1e4, 1e4)

    def static_zernike_nm(self, diversity_nm: Mapping[int, float]) -> Mapping[int, float]:
        """See `WavefrontEffect.static_zernike_nm`."""
        return self.zernike_nm
