"""Residual wavefront of the adaptive optics, screens that drift with the wind and boil, and image motion.

The spectrum has two parts, divided at the cut-off of the deformable mirror: von Karman turbulence
beyond it, which the mirror cannot follow, and a power law of slope -2 inside it. The variance of the
inner part is what the seeing law leaves after the outer one.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from scipy.signal import lfilter

from simulator.telescope import Telescope

CUT_OFF_PER_M = 2.5
OUTER_SCALE_M = 25.0
IN_BAND_SLOPE = -2.0
SCREEN_OVER_PUPIL = 1.6  # edge of the periodic screen over the pupil diameter
IN_BAND_LIFETIME_S = 0.010  # the loop renews its residual within a few of its steps
FITTING_LIFETIME_S = 0.200
IN_BAND_WIND_M_S = (6.0, 2.0)
FITTING_WIND_M_S = (10.0, -4.0)
VIBRATION_HZ = 48.3
VIBRATION_DAMPING = 0.01
VIBRATION_SHARE = 0.35  # part of the variance of the image motion
WANDER_BANDWIDTH_HZ = 4.0


def residual_wfe_nm(seeing_arcsec: float) -> float:
    """Return the residual WFE [nm RMS] of the GALACSI NFM seeing law, piston and tip-tilt excluded."""
    return 104.27 * seeing_arcsec + 58.6


def fried_parameter_m(seeing_arcsec: float, wavelength_m: float = 500e-9) -> float:
    """Return r0 [m] at the given wavelength: seeing = 0.98 lambda / r0."""
    return 0.98 * wavelength_m / np.deg2rad(seeing_arcsec / 3600)


def von_karman_psd_nm2_m2(frequency_per_m: np.ndarray, seeing_arcsec: float) -> np.ndarray:
    """Return the OPD power spectrum [nm^2 m^2] of uncorrected turbulence."""
    nm_per_rad = 500.0 / (2 * np.pi)
    strength = 0.0229 * fried_parameter_m(seeing_arcsec) ** (-5 / 3) * nm_per_rad**2
    return strength * (frequency_per_m**2 + OUTER_SCALE_M**-2) ** (-11 / 6)


class ResidualScreens:
    """Sequence of residual wavefronts, `step_s` apart.

    Every Fourier mode is a first-order autoregressive process: between two steps its phase turns
    with the wind (frozen flow) and a part of it is replaced by fresh noise (boiling), so the variance
    stays what the spectrum says. The WFE without piston, tip and tilt obeys the seeing law.
    """

    def __init__(self, telescope: Telescope, seeing_arcsec: float, step_s: float, rng: np.random.Generator):
        self._rng = rng
        self._samples = telescope.transmission.shape[0]
        self._size = scipy.fft.next_fast_len(int(SCREEN_OVER_PUPIL * self._samples))
        self._weight = telescope.transmission / telescope.transmission.sum()
        self._basis = self._piston_tip_tilt(telescope)
        self._weighted_basis = self._basis * self._weight.ravel()
        frequency = np.fft.fftfreq(self._size, telescope.step_m)
        fx, fy = frequency[None, :], frequency[:, None]
        modulus = np.hypot(fx, fy)
        in_band = (modulus < CUT_OFF_PER_M) & (modulus > 0)
        memory = _memory(fx, fy, in_band, step_s)
        self._memory = memory.astype(np.complex64)
        # The real part of the complex screen is used, hence both parts carry the full variance.
        power_nm2 = self._power_nm2(modulus, in_band, telescope.step_m, seeing_arcsec)
        amplitude = np.sqrt(power_nm2) * self._size**2
        self._refresh = (amplitude * np.sqrt(1 - np.abs(memory) ** 2)).astype(np.float32)
        self._modes = amplitude.astype(np.float32) * self._noise()

    def _piston_tip_tilt(self, telescope: Telescope) -> np.ndarray:
        """Orthonormal over the pupil with its transmission as weight, (3, n*n)."""
        weight = np.sqrt(self._weight).ravel()
        vectors, _ = np.linalg.qr((telescope.modes[:3].reshape(3, -1) * weight).T)
        return np.divide(vectors.T, weight, out=np.zeros_like(vectors.T), where=weight > 0)

    def _power_nm2(
        self, modulus: np.ndarray, in_band: np.ndarray, step_m: float, seeing_arcsec: float
    ) -> np.ndarray:
        """Variance that each Fourier mode contributes to a screen [nm^2]."""
        cell_per_m2 = (1 / (self._size * step_m)) ** 2
        turbulence = von_karman_psd_nm2_m2(modulus, seeing_arcsec)
        fitting = np.where(modulus >= CUT_OFF_PER_M, turbulence, 0.0) * cell_per_m2
        inner = np.where(in_band, np.where(in_band, modulus, 1.0) ** IN_BAND_SLOPE, 0.0)
        # the part of the pupil variance of each mode that is not piston, tip or tilt
        weighted = self._basis.reshape(3, *self._weight.shape) * self._weight
        spectra = scipy.fft.fft2(weighted, s=(self._size, self._size))
        kept = 1 - np.sum(np.abs(spectra) ** 2, axis=0)
        inner_nm2 = residual_wfe_nm(seeing_arcsec) ** 2 - np.sum(kept * fitting)
        return fitting + inner * inner_nm2 / np.sum(kept * inner)

    def _noise(self) -> np.ndarray:
        return self._rng.standard_normal((self._size, 2 * self._size), dtype=np.float32).view(np.complex64)

    def next_nm(self) -> np.ndarray:
        """Advance by one step and return the OPD (n, n) [nm] without piston, tip and tilt over the pupil."""
        self._modes = self._modes * self._memory + self._refresh * self._noise()
        screen = scipy.fft.ifft2(self._modes).real[: self._samples, : self._samples].ravel()
        return (screen - (self._weighted_basis @ screen) @ self._basis).reshape(self._samples, -1)


def _memory(fx: np.ndarray, fy: np.ndarray, in_band: np.ndarray, step_s: float) -> np.ndarray:
    """Return the complex factor from one step to the next of every Fourier mode."""
    lifetime_s = np.where(in_band, IN_BAND_LIFETIME_S, FITTING_LIFETIME_S)
    wind = [np.where(in_band, *pair) for pair in zip(IN_BAND_WIND_M_S, FITTING_WIND_M_S, strict=True)]
    turn = -2j * np.pi * (fx * wind[0] + fy * wind[1]) * step_s
    return np.exp(-step_s / lifetime_s + turn)


def jitter_mas(rms_mas: float, step_s: float, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Return image motion in x and y, (steps, 2) [mas], rms_mas per axis over a long time.

    A slow wander plus a vibration line of the telescope.
    """
    # AR(2) coefficients of a damped oscillator
    turn = 2 * np.pi * VIBRATION_HZ * step_s
    decay = np.exp(-VIBRATION_DAMPING * turn)
    vibration = (2 * decay * np.cos(turn * np.sqrt(1 - VIBRATION_DAMPING**2)), -(decay**2))
    wander = (float(np.exp(-2 * np.pi * WANDER_BANDWIDTH_HZ * step_s)), 0.0)
    axes = [
        np.sqrt(VIBRATION_SHARE) * _autoregressive(vibration, steps, rng)
        + np.sqrt(1 - VIBRATION_SHARE) * _autoregressive(wander, steps, rng)
        for _ in range(2)
    ]
    return rms_mas * np.stack(axes, axis=1)


def _autoregressive(coefficients: tuple[float, float], steps: int, rng: np.random.Generator) -> np.ndarray:
    """Return a stationary series x_k = c1 x_{k-1} + c2 x_{k-2} + noise of unit variance, (steps,)."""
    c1, c2 = coefficients
    drive = np.sqrt((1 + c2) * ((1 - c2) ** 2 - c1**2) / (1 - c2))
    settling = 2000 + steps
    series = lfilter([drive], [1.0, -c1, -c2], rng.standard_normal(settling + steps))
    return series[settling:]
