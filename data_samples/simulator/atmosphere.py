"""Residual wavefront of the adaptive optics: screens that drift with the wind and boil.

The spectrum has two parts, divided at the cut-off of the deformable mirror: von Karman turbulence
beyond it, which the mirror cannot follow, and a power law of slope -2 inside it. The variance of the
inner part is what the seeing law leaves after the outer one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from simulator.telescope import Telescope

CUT_OFF_PER_M = 2.5
OUTER_SCALE_M = 25.0
IN_BAND_SLOPE = -2.0
SCREEN_OVER_PUPIL = 1.6  # edge of the periodic screen over the pupil diameter
IN_BAND_LIFETIME_S = 0.010  # the loop renews its residual within a few of its steps
FITTING_LIFETIME_S = 0.200
IN_BAND_WIND_M_S = (6.0, 2.0)
FITTING_WIND_M_S = (10.0, -4.0)


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


@dataclass(frozen=True)
class ResidualSpectrum:
    """Power of every Fourier mode of the screen and how the mode evolves.

    Attributes
    ----------
    power_nm2 : ndarray, (m, m)
        Variance that the Fourier mode contributes to a screen [nm^2].
    frequency_per_m : tuple of ndarray
        fx of shape (1, m) and fy of shape (m, 1).
    in_band : ndarray of bool, (m, m)
        True for modes that the deformable mirror corrects.
    piston_tip_tilt : ndarray, (3, n*n)
        Piston, tip and tilt, orthonormal over the pupil with its transmission as weight.
    """

    power_nm2: np.ndarray
    frequency_per_m: tuple[np.ndarray, np.ndarray]
    in_band: np.ndarray
    piston_tip_tilt: np.ndarray


def residual_spectrum(telescope: Telescope, seeing_arcsec: float) -> ResidualSpectrum:
    """Return the spectrum whose WFE without piston, tip and tilt obeys the seeing law."""
    samples = telescope.transmission.shape[0]
    size = scipy.fft.next_fast_len(int(SCREEN_OVER_PUPIL * samples))
    frequency = np.fft.fftfreq(size, telescope.step_m)
    fx, fy = frequency[None, :], frequency[:, None]
    modulus = np.hypot(fx, fy)
    in_band = (modulus < CUT_OFF_PER_M) & (modulus > 0)
    cell_per_m2 = (1 / (size * telescope.step_m)) ** 2
    fitting = (
        np.where(modulus >= CUT_OFF_PER_M, von_karman_psd_nm2_m2(modulus, seeing_arcsec), 0.0) * cell_per_m2
    )
    inner = np.where(in_band, np.where(in_band, modulus, 1.0) ** IN_BAND_SLOPE, 0.0)
    basis = _orthonormal_piston_tip_tilt(telescope)
    kept = _kept_fraction(telescope, basis, size)
    inner_nm2 = residual_wfe_nm(seeing_arcsec) ** 2 - np.sum(kept * fitting)
    power = fitting + inner * inner_nm2 / np.sum(kept * inner)
    return ResidualSpectrum(power, (fx, fy), in_band, basis)


def _orthonormal_piston_tip_tilt(telescope: Telescope) -> np.ndarray:
    weight = np.sqrt(telescope.transmission / telescope.transmission.sum()).ravel()
    vectors, _ = np.linalg.qr((telescope.modes[:3].reshape(3, -1) * weight).T)
    return np.divide(vectors.T, weight, out=np.zeros_like(vectors.T), where=weight > 0)


def _kept_fraction(telescope: Telescope, basis: np.ndarray, size: int) -> np.ndarray:
    """Return, for every Fourier mode, the part of its pupil variance that is not piston, tip or tilt."""
    transmission = telescope.transmission
    weighted = basis.reshape(3, *transmission.shape) * (transmission / transmission.sum())
    return 1 - np.sum(np.abs(scipy.fft.fft2(weighted, s=(size, size))) ** 2, axis=0)


class ResidualScreens:
    """Sequence of residual wavefronts.

    Every Fourier mode is a first-order autoregressive process: between two steps its phase turns
    with the wind (frozen flow) and a part of it is replaced by fresh noise (boiling), so the variance
    stays what the spectrum says.

    Parameters
    ----------
    telescope : Telescope
    seeing_arcsec : float
    step_s : float
        Time between two screens [s].
    rng : numpy.random.Generator
    """

    def __init__(self, telescope: Telescope, seeing_arcsec: float, step_s: float, rng: np.random.Generator):
        spectrum = residual_spectrum(telescope, seeing_arcsec)
        self._rng = rng
        self._samples = telescope.transmission.shape[0]
        self._weighted_basis = (
            spectrum.piston_tip_tilt * (telescope.transmission / telescope.transmission.sum()).ravel()
        )
        self._basis = spectrum.piston_tip_tilt
        memory = _memory(spectrum, step_s)
        size = spectrum.power_nm2.shape[0]
        self._memory = memory.astype(np.complex64)
        # The real part of the complex screen is used, hence both parts carry the full variance.
        amplitude = np.sqrt(spectrum.power_nm2) * size**2
        self._refresh = (amplitude * np.sqrt(1 - np.abs(memory) ** 2)).astype(np.float32)
        self._modes = amplitude.astype(np.float32) * self._noise(size)

    def _noise(self, size: int) -> np.ndarray:
        return self._rng.standard_normal((size, 2 * size), dtype=np.float32).view(np.complex64)

    def next_nm(self) -> np.ndarray:
        """Advance by one step and return the OPD (n, n) [nm] without piston, tip and tilt over the pupil."""
        self._modes = self._modes * self._memory + self._refresh * self._noise(self._modes.shape[0])
        screen = scipy.fft.ifft2(self._modes).real[: self._samples, : self._samples].ravel()
        return (screen - (self._weighted_basis @ screen) @ self._basis).reshape(self._samples, -1)


def _memory(spectrum: ResidualSpectrum, step_s: float) -> np.ndarray:
    """Return the complex factor from one step to the next of every Fourier mode."""
    fx, fy = spectrum.frequency_per_m
    lifetime_s = np.where(spectrum.in_band, IN_BAND_LIFETIME_S, FITTING_LIFETIME_S)
    wind = [
        np.where(spectrum.in_band, *pair) for pair in zip(IN_BAND_WIND_M_S, FITTING_WIND_M_S, strict=True)
    ]
    turn = -2j * np.pi * (fx * wind[0] + fy * wind[1]) * step_s
    return np.exp(-step_s / lifetime_s + turn)
