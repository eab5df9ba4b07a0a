"""The disturbance of the slow focus loop: the sodium layer's mean altitude wanders.

The high-order loop keeps the laser spots in focus, so a layer that rises by δh leaves the telescope
out of focus for stars by the difference of the two spherical waves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.special import gamma

Lag = TypeVar("Lag", float, np.ndarray)


@dataclass(frozen=True)
class SodiumLayer:
    """Fractional Brownian motion of the layer's altitude, a power-law spectrum ``S ∝ f^-slope``."""

    # Between 1 and 3; 2 is a random walk. 1.95 ± 0.12 up to more than 1 Hz: Pfrommer & Hickson 2010, J. Opt.
    # Soc. Am. A 27, A97; 1.79 ± 0.02 below 4 mHz: Davis et al. 2006, Opt. Lett. 31, 3369.
    slope: float
    rms_change_1s_m: float  # RMS change of altitude within a second: 23 m, Pfrommer & Hickson 2010
    # From the telescope to the layer; 92 km above the sea less the height of Paranal, at zenith. There the
    # effect is largest: it goes with the cosine of the zenith angle.
    range_m: float

    def defocus_per_metre_nm(self, diameter_m: float) -> float:
        """Return the defocus [nm RMS] per metre of altitude: ``D² / (16 √3 h²)``.

        The sag ``ρ² δh / 2h²`` over the radius D/2 is ``2√3 a ρ²`` of a defocus a. At 30 m it is the
        4 nm/m of Pfrommer & Hickson.
        """
        return 1e9 * diameter_m**2 / (16 * np.sqrt(3) * self.range_m**2)

    def drift(self, diameter_m: float) -> Drift:
        return Drift(self.slope, self.rms_change_1s_m * self.defocus_per_metre_nm(diameter_m))


@dataclass(frozen=True)
class Drift:
    """Fractional Brownian motion of defocus."""

    slope: float  # of the power spectrum, between 1 and 3
    rms_change_1s_nm: float  # σ₁ of the structure function ``D(τ) = σ₁² τ^(slope-1)``, τ in seconds

    def structure_nm2(self, lag_s: Lag) -> Lag:
        """Return the mean square change within a time [nm²]."""
        return self.rms_change_1s_nm**2 * np.abs(lag_s) ** (self.slope - 1)

    def psd_nm2_hz(self, f_hz: np.ndarray) -> np.ndarray:
        """Return the one-sided power spectral density [nm²/Hz] that has this structure function.

        ``D(τ) = 2 ∫ S (1 - cos 2πfτ) df`` and ``∫ x^-p (1 - cos x) dx = π / (2 Γ(p) sin(π(p-1)/2))``.
        """
        p = self.slope
        integral = np.pi / (2 * gamma(p) * np.sin(np.pi * (p - 1) / 2))
        return self.rms_change_1s_nm**2 / (2 * (2 * np.pi) ** (p - 1) * integral) * f_hz**-p

    def wander_within_nm2(self, duration_s: float) -> float:
        """Return the variance about the mean of an interval [nm²]: ``½ ⟨D⟩`` over all pairs of moments."""
        p = self.slope
        return float(self.structure_nm2(duration_s) / (p * (p + 1)))

    def draw_nm(self, rng: np.random.Generator, steps: int, step_s: float) -> np.ndarray:
        """Draw a drift that begins at 0, (`steps`,) [nm RMS], one value every `step_s`, with `rng`.

        The increments are drawn with their exact covariance by circulant embedding (Davies & Harte 1987).
        """
        lags = np.arange(steps + 1) * step_s
        d = self.structure_nm2(lags)
        # Of the increments, lags 0 to steps - 1.
        covariance = 0.5 * (d[1:] - 2 * d[:-1] + np.append(d[1], d[:-2]))
        covariance[0] = d[1]
        spectrum = np.fft.fft(np.concatenate([covariance, covariance[-2:0:-1]])).real.clip(0)
        size = len(spectrum)
        noise = rng.standard_normal(size) + 1j * rng.standard_normal(size)
        increments = np.fft.fft(np.sqrt(spectrum / size) * noise).real[: steps - 1]
        return np.concatenate([[0.0], np.cumsum(increments)])
