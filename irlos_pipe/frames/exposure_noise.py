"""Noise of an exposure that is read many times, with the light of the sky and dark current in it."""

from __future__ import annotations

from dataclasses import dataclass

from irlos_pipe.frames.noise import NoiseModel


@dataclass(frozen=True)
class ExposureNoise:
    """What makes the noise of one exposure.

    Attributes
    ----------
    reads : int
        That are added up.
    read_noise_e : float
        Of one read, rounding to whole ADU included [e- RMS].
    excess_noise_factor : float
    sky_e, dark_e : float
        Mean charge by sky and dark current in a pixel of the exposure [e-].
    """

    reads: int
    read_noise_e: float
    excess_noise_factor: float
    sky_e: float = 0.0
    dark_e: float = 0.0

    @property
    def floor_e2(self) -> float:
        """Variance of a pixel without star, ``N σ² + F (sky + dark)`` [e-²]."""
        photons_e2 = self.excess_noise_factor * (self.sky_e + self.dark_e)
        return self.reads * self.read_noise_e**2 + photons_e2

    def beyond(self, recorded: NoiseModel) -> NoiseModel:
        """Return this noise, or what was `recorded` where that is more."""
        return NoiseModel(
            max(self.excess_noise_factor, recorded.excess_noise_factor),
            max(self.floor_e2, recorded.floor_e2),
            recorded.shared_e2,
        )
