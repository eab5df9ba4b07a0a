"""Linear theory of the slow loop: what an integrator with delay leaves of a drift, and which gain is best.

Frame k is exposed while the command stays at ``c_k``; its measurement ``m_k`` is ready `delay` frames
after the exposure has ended: ``c_{k+1+delay} = c_{k+delay} + gain · m_k``.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import gamma

from irlos_pipe.conventions.keys import key

Lag = TypeVar("Lag", float, np.ndarray)

GRID = 4096  # frequencies up to Nyquist's, in the integral over the spectrum
ALIASES = 30  # replicas of the spectrum on each side; the mean over a frame damps them by f^-4


@dataclass(frozen=True)
class SodiumLayer:
    """Fractional Brownian motion of the layer's altitude, a power-law spectrum ``S ∝ f^-slope``."""

    # Between 1 and 3; 2 is a random walk. 1.95 ± 0.12 up to more than 1 Hz: Pfrommer & Hickson 2010, J. Opt.
    # Soc. Am. A 27, A97; 1.79 ± 0.02 below 4 mHz: Davis et al. 2006, Opt. Lett. 31, 3369.
    slope: float = key(1.95, "of the altitude's power spectrum, f^-slope", gt=1, lt=3)
    rms_change_1s_m: float = key(23.0, "RMS change of the mean altitude within 1 s [m]", gt=0)  # Pfrommer
    # 92 km above the sea less the height of Paranal, at zenith. There the effect is largest: it goes with the
    # cosine of the zenith angle.
    range_m: float = key(89.4e3, "from the telescope to the layer [m]", gt=1e4)

    def defocus_per_metre_nm(self, diameter_m: float) -> float:
        """Return the defocus [nm RMS] per metre of altitude: ``D² / (16 √3 h²)``.

        The sag ``ρ² δh / 2h²`` over the radius D/2 is ``2√3 a ρ²`` of a defocus a. At 30 m it is the
        4 nm/m of Pfrommer & Hickson.
        """
        return 1e9 * diameter_m**2 / (16 * np.sqrt(3) * self.range_m**2)

    def drift(self, diameter_m: float) -> "Drift":
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


@dataclass(frozen=True)
class Integrator:
    """An integrating controller with delay, as linear theory sees it."""

    gain: float
    frame_s: float = 1.0  # exposure time, and time between two frames
    delay: int = 1  # whole frames between the end of an exposure and the command that follows from it

    @property
    def largest_stable_gain(self) -> float:
        """Return the gain above which the poles of ``z^(delay+1) - z^delay + gain`` leave the unit circle."""
        return float(2 * np.sin(np.pi / (2 * (2 * self.delay + 1))))

    def gain_margin(self, sensor_slope: float) -> float:
        """Return the factor by which the gain could grow before the loop oscillates."""
        return self.largest_stable_gain / (self.gain * sensor_slope)

    def rejection(self, f_hz: np.ndarray, sensor_slope: float = 1.0) -> np.ndarray:
        """Return residual over disturbance, means over frames, complex, at `f_hz`, (frequencies,).

        A sensor's slope is its measured over the true residual, here and below.
        """
        z1 = np.exp(-2j * np.pi * f_hz * self.frame_s)
        return (1 - z1) / (1 - z1 + self.gain * sensor_slope * z1 ** (1 + self.delay))

    def noise_transfer(self, f_hz: np.ndarray, sensor_slope: float = 1.0) -> np.ndarray:
        """Return residual over noise of the measurement, complex."""
        z1 = np.exp(-2j * np.pi * f_hz * self.frame_s)
        return -self.gain * z1 ** (1 + self.delay) / (1 - z1) * self.rejection(f_hz, sensor_slope)

    def residual_nm(self, drift: Drift, noise_nm: float, sensor_slope: float = 1.0) -> float:
        """Return the RMS defocus that drift and white measurement noise leave; infinite if unstable.

        It is the mean over time, what wanders within a frame included; `noise_nm` is that of a measurement
        [nm RMS].
        """
        if self.gain * sensor_slope >= self.largest_stable_gain:
            return float("inf")
        width_hz = 0.5 / self.frame_s / GRID
        f_hz = (np.arange(GRID) + 0.5) * width_hz  # up to Nyquist's
        replicas = f_hz[:, None] + np.arange(-ALIASES, ALIASES + 1) / self.frame_s
        of_means = drift.psd_nm2_hz(np.abs(replicas)) * np.sinc(replicas * self.frame_s) ** 2
        followed = np.abs(self.rejection(f_hz, sensor_slope)) ** 2 * np.sum(of_means, axis=1)
        noise = np.mean(np.abs(self.noise_transfer(f_hz, sensor_slope)) ** 2) * noise_nm**2
        return float(np.sqrt(followed.sum() * width_hz + noise + drift.wander_within_nm2(self.frame_s)))


def best_gain(drift: Drift, noise_nm: float, frame_s: float = 1.0, delay: int = 1) -> float:
    """Return the gain with the smallest residual, see `Integrator`."""
    limit = Integrator(1.0, frame_s, delay).largest_stable_gain
    found = minimize_scalar(
        lambda log_gain: Integrator(np.exp(log_gain), frame_s, delay).residual_nm(drift, noise_nm),
        bounds=(np.log(1e-3), np.log(0.95 * limit)),
        method="bounded",
    )
    return float(np.exp(found.x))
