"""Screens of the AO residual that drift with the wind and boil."""

from __future__ import annotations

import numpy as np
import scipy.fft

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.simulate.atmosphere import Sky, residual_psd
from irlos_pipe.simulate.errors import SceneError
from irlos_pipe.simulate.telescope import Telescope

SCREEN_OVER_PUPIL = 1.6  # edge of the periodic screen over the pupil's
IN_BAND_LIFETIME_S = 0.010  # the loop renews its residual within a few of its steps
FITTING_LIFETIME_S = 0.200


class ResidualScreens:
    """Residual wavefronts from one moment to the next, without piston, tip and tilt over the pupil.

    Every Fourier mode is a complex first-order autoregressive process: its phase turns with the wind
    (frozen flow) and a part of it is replaced by noise (boiling), so its variance stays. The screen is
    real, hence only modes with fx >= 0 are kept.

    Parameters
    ----------
    sky : Sky
    facility : Facility
    telescope : Telescope
    rng : numpy.random.Generator

    Raises
    ------
    SceneError
        If the fitting error alone exceeds the total residual.
    """

    def __init__(self, sky: Sky, facility: Facility, telescope: Telescope, rng: np.random.Generator):
        self._rng, self._sky, self._facility, self._n = rng, sky, facility, len(telescope.u_m)
        self._size = scipy.fft.next_fast_len(int(SCREEN_OVER_PUPIL * self._n), real=True)
        self._fx = np.fft.rfftfreq(self._size, telescope.step_m)[None, :]
        self._fy = np.fft.fftfreq(self._size, telescope.step_m)[:, None]
        self._basis, self._projector = _piston_tip_tilt(telescope)
        self._amplitude_nm = np.sqrt(self._variance_nm2(telescope.step_m))
        self._steps: dict[float, tuple[np.ndarray, np.ndarray]] = {}
        self._modes = self._amplitude_nm.astype(np.float32) * self._noise()
        self._in_band = np.hypot(self._fx, self._fy) < facility.cutoff_per_m
        variance = sum((part * telescope.mode(noll) for noll, part in sky.variance_zernike.items()), 1.0)
        self._local = np.sqrt(np.maximum(variance, 0.0)).astype(np.float32)
        self._strength = _Strength(sky, rng)

    def next_nm(self, step_s: float) -> np.ndarray:
        """Return the wavefront after one step of `step_s`, (n, n) float32 [nm]."""
        self.skip(step_s)
        screen = self._screen_nm().ravel()
        flat = screen - (self._projector @ screen) @ self._basis
        return flat.reshape(self._n, self._n) * np.float32(self._strength.factor)

    def _screen_nm(self) -> np.ndarray:
        """The wavefront with piston, tip and tilt, (n, n)."""
        if not self._sky.variance_zernike:
            return self._on_pupil(self._modes)
        inside = np.where(self._in_band, self._modes, 0)
        return self._on_pupil(self._modes - inside) + self._local * self._on_pupil(inside)

    def _on_pupil(self, modes: np.ndarray) -> np.ndarray:
        periodic = scipy.fft.irfft2(modes, s=(self._size, self._size), norm="forward")
        return periodic[: self._n, : self._n]

    def skip(self, time_s: float) -> None:
        """Let `time_s` pass unobserved."""
        memory, fresh_nm = self._step(time_s)
        self._modes = self._modes * memory + fresh_nm * self._noise()
        self._strength.advance(time_s)

    def _noise(self) -> np.ndarray:
        """Complex normal numbers, unit variance of both parts, one per mode, complex64."""
        parts = self._rng.standard_normal((self._size, 2 * self._fx.size), dtype=np.float32)
        return parts.view(np.complex64)

    def _step(self, step_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Factor of every mode from one step to the next, and the size of its fresh noise."""
        if step_s not in self._steps:
            lifetime_s = np.where(self._in_band, IN_BAND_LIFETIME_S, FITTING_LIFETIME_S)
            drift_hz = self._fx * self._sky.wind[0] + self._fy * self._sky.wind[1]
            memory = np.exp((-2j * np.pi * drift_hz - 1 / lifetime_s) * step_s)
            fresh_nm = self._amplitude_nm * np.sqrt(1 - np.abs(memory) ** 2)
            self._steps[step_s] = memory.astype(np.complex64), fresh_nm.astype(np.float32)
        return self._steps[step_s]

    def _variance_nm2(self, step_m: float) -> np.ndarray:
        """Variance of the real part of every kept mode [nm²]; in-band scaled to the total residual."""
        inside, beyond = residual_psd(self._fx, self._fy, self._sky, self._facility)
        beyond_nm2 = beyond / (self._size * step_m) ** 2
        stands_for = self._stands_for()
        seen = stands_for * self._seen_by_pupil()
        total_nm = self._sky.total_nm(self._facility.residual_law)
        inside_nm2 = total_nm**2 - np.sum(seen * beyond_nm2)
        if inside_nm2 <= 0:
            raise SceneError(
                f"sky: wfe_nm = {total_nm:.0f} is less than the fitting error that "
                f"{self._sky.seeing_arcsec:g} arcsec leave beyond the cut-off; raise it, or lower the seeing"
            )
        power_nm2 = beyond_nm2 + inside * inside_nm2 / np.sum(seen * inside)
        # Twice the real part of a mode is added where it stands for its mirror image too.
        return np.divide(power_nm2, stands_for, out=np.zeros_like(power_nm2), where=stands_for > 0)

    def _stands_for(self) -> np.ndarray:
        """How many modes of the whole plane a kept mode stands for; those at Nyquist's fx are left out."""
        count = np.full(self._fx.shape, 2.0)
        count[0, 0] = 1.0
        if self._size % 2 == 0:
            count[0, -1] = 0.0
        return np.broadcast_to(count, (self._size, self._fx.size))

    def _seen_by_pupil(self) -> np.ndarray:
        """Part of every mode's variance over the pupil that is not piston, tip or tilt."""
        weighted = self._projector.reshape(3, self._n, self._n)
        spectra = scipy.fft.rfft2(weighted, s=(self._size, self._size))
        return 1 - np.sum(np.abs(spectra) ** 2, axis=0)


class _Strength:
    """Slow log-normal drift of the residual's size, with mean square 1; none for stationary skies."""

    def __init__(self, sky: Sky, rng: np.random.Generator):
        self._rng, self._lifetime_s = rng, sky.drift_s
        self._spread = np.sqrt(np.log1p(sky.drift_rms**2)) if sky.shape == "non_stationary" else 0.0
        self._state = rng.standard_normal()

    @property
    def factor(self) -> float:
        return float(np.exp(self._spread * self._state - self._spread**2))

    def advance(self, time_s: float) -> None:
        memory = np.exp(-time_s / self._lifetime_s)
        self._state = memory * self._state + np.sqrt(1 - memory**2) * self._rng.standard_normal()


def _piston_tip_tilt(telescope: Telescope) -> tuple[np.ndarray, np.ndarray]:
    """Piston, tip and tilt, orthonormal over the pupil, and the same weighted to project; (3, n²) each."""
    weight = (telescope.transmission / telescope.transmission.sum()).ravel()
    modes = np.array([telescope.mode(noll).ravel() for noll in (1, 2, 3)])
    basis = np.linalg.solve(np.linalg.cholesky((modes * weight) @ modes.T), modes)
    return basis.astype(np.float32), (basis * weight).astype(np.float32)
