"""AO residual: its size, its spectrum, and screens that drift with the wind and boil."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
import scipy.fft

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.keys import key
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.simulate import SceneError, require_known
from irlos_pipe.simulate.telescope import Telescope

VON_KARMAN = 0.0229  # coefficient of the phase spectrum, in rad² m^(-11/3) r0^(-5/3)
SEEING_NM = 500.0
WIND_SCATTER = 0.3  # relative scatter of the wind vectors of all layers about their mean
ALIASING_SHARE = 0.6  # part of the in-band variance of the shape `aliasing`; the rest is servo lag
ALIASES = 3  # folded bands on each side of the correction band that are summed
Shape = Literal["power_law", "servo_lag", "aliasing", "non_stationary"]

SCREEN_OVER_PUPIL = 1.6  # edge of the periodic screen over the pupil's
IN_BAND_LIFETIME_S = 0.010  # the loop renews its residual within a few of its steps
FITTING_LIFETIME_S = 0.200


@dataclass(frozen=True)
class Sky:
    """AO residual; its size follows the seeing unless `wfe_nm` is given.

    Shapes inside the correction band: ``power_law``, a PSD of ``f**-slope``; ``servo_lag``, stretched along
    the wind; ``aliasing``, rising towards the cut-off; ``non_stationary``, a power law whose strength drifts.
    `wfe_nm` is a long-term average over the pupil without piston, tip and tilt; `variance_zernike` are Noll
    modes of the variance inside the band over the pupil, beside one.
    """

    seeing_arcsec: float = key(0.5, "at 500 nm, on SPARTA's scale", ge=0.1, le=4)
    wfe_nm: float | None = key(None, "total residual, nm RMS", ge=0, le=1000)
    shape: Shape = key("power_law", "of the spectrum inside the correction band")
    slope: float = key(2.0, "the power law falls like f**-slope", ge=0, le=6)
    wind_m_s: float = key(10.0, "wind speed", ge=0, le=100)
    wind_angle_deg: float = key(-20.0, "from +x towards +y", ge=-720, le=720)
    delay_s: float = key(0.003, "of the loop; sets the servo lag", gt=0, le=1)
    drift_rms: float = key(0.25, "relative, of the size in shape non_stationary", ge=0, le=1)
    drift_s: float = key(5.0, "correlation time of that drift", gt=0, le=1e4)
    # made by an effect, and no key
    variance_zernike: Mapping[int, float] = field(
        default_factory=dict, metadata={"alias": "", "exclude": True}
    )

    def __post_init__(self) -> None:
        require_known("sky.shape", [self.shape], get_args(Shape))
        if self.seeing_arcsec <= 0:
            raise SceneError(f"sky.seeing_arcsec: {self.seeing_arcsec:g} is not positive; leave out the sky")
        if self.wind_m_s == 0 and self.shape in ("servo_lag", "aliasing"):
            raise SceneError(f"shape {self.shape} needs wind; give wind_m_s above 0")

    def total_nm(self, law: ResidualLaw) -> float:
        """Return the total residual [nm RMS], by the `law` unless it is given."""
        return law.wfe_nm(self.seeing_arcsec) if self.wfe_nm is None else self.wfe_nm

    @property
    def wind(self) -> np.ndarray:
        angle = np.deg2rad(self.wind_angle_deg)
        return self.wind_m_s * np.array([np.cos(angle), np.sin(angle)])

    def scaled(self, factor: float, law: ResidualLaw) -> "Sky":
        """Return the `law`'s residual times `factor`; the fitting error grows as seeing^(5/6)."""
        total_nm = self.total_nm(law) * factor
        return replace(self, seeing_arcsec=self.seeing_arcsec * factor**1.2, wfe_nm=total_nm)


def residual_psd(
    fx: np.ndarray, fy: np.ndarray, sky: Sky, facility: Facility
) -> tuple[np.ndarray, np.ndarray]:
    """Return the power spectral densities inside and beyond the correction band, at `fx` and `fy` [1/m].

    That inside is known up to a factor; beyond it is the uncorrected turbulence [nm² m²]. The `facility`
    gives the cut-off and the outer scale, the `sky` the rest.
    """
    fx, fy = np.broadcast_arrays(fx, fy)
    f = np.hypot(fx, fy)
    in_band, beyond_band = (f > 0) & (f < facility.cutoff_per_m), f >= facility.cutoff_per_m
    inside, beyond = np.zeros(f.shape), np.zeros(f.shape)
    inside[in_band] = _in_band(fx[in_band], fy[in_band], sky, facility)
    beyond[beyond_band] = von_karman_nm2_m2(f[beyond_band], sky, facility)
    return inside, beyond


def von_karman_nm2_m2(f_per_m: np.ndarray, sky: Sky, facility: Facility) -> np.ndarray:
    """Return the von Kármán spectrum of the uncorrected turbulence at `f_per_m` [nm² m²].

    ``0.0229 r0^(-5/3) (f² + L0^-2)^(-11/6)`` rad² m² with ``r0 = 0.976 λ / seeing`` (Roddier 1981); the
    seeing is that of the `sky`, the outer scale the `facility`'s.
    """
    r0_m = 0.976 * SEEING_NM * 1e-9 / np.deg2rad(sky.seeing_arcsec / 3600)
    strength = VON_KARMAN * r0_m ** (-5 / 3) * (SEEING_NM / (2 * np.pi)) ** 2
    return strength * (f_per_m**2 + facility.outer_scale_m**-2) ** (-11 / 6)


def _in_band(fx: np.ndarray, fy: np.ndarray, sky: Sky, facility: Facility) -> np.ndarray:
    if sky.shape == "servo_lag":
        return servo_lag_psd(fx, fy, sky, facility)
    if sky.shape == "aliasing":
        aliasing, lag = aliasing_psd(fx, fy, sky, facility), servo_lag_psd(fx, fy, sky, facility)
        return ALIASING_SHARE * aliasing / aliasing.sum() + (1 - ALIASING_SHARE) * lag / lag.sum()
    return np.hypot(fx, fy) ** -sky.slope


def servo_lag_psd(fx: np.ndarray, fy: np.ndarray, sky: Sky, facility: Facility) -> np.ndarray:
    """Return the spectrum at `fx`, `fy` [1/m] of turbulence that moved on during the loop's delay [nm² m²].

    ``PSD = vK(f) q / (1 + q)`` with ``q = (2π τ)² <(f·v)²>``: for short delays the difference of the
    wavefront of the `sky` over the `facility` to its own shifted past, bounded by the turbulence itself. The
    mean over the layers' winds leaves something across the mean wind too.
    """
    along, f2 = fx * sky.wind[0] + fy * sky.wind[1], fx**2 + fy**2
    spread = (WIND_SCATTER * sky.wind_m_s) ** 2 * f2
    moved = (2 * np.pi * sky.delay_s) ** 2 * (along**2 + spread)
    return von_karman_nm2_m2(np.sqrt(f2), sky, facility) * moved / (1 + moved)


def aliasing_psd(fx: np.ndarray, fy: np.ndarray, sky: Sky, facility: Facility) -> np.ndarray:
    """Return the spectrum of turbulence that a Shack–Hartmann sensor takes for low frequencies [nm² m²].

    A sub-aperture of pitch d measures the gradient ``2πi f φ sinc(d fx) sinc(d fy)``. Sampled at d, the
    gradients at ``g = f + k/d`` appear at f, (`fx`, `fy`) [1/m], and the least-squares reconstructor returns
    ``φ(g) (f·g / f²) sinc(d g) / sinc(d f)`` for each k ≠ 0 (Rigaut et al. 1998; Jolissaint 2010). The
    cut-off of the `facility` gives the pitch, the `sky` the turbulence.
    """
    pitch_m, f2 = 1 / (2 * facility.cutoff_per_m), fx**2 + fy**2
    total = np.zeros(f2.shape)
    for kx in range(-ALIASES, ALIASES + 1):
        for ky in range(-ALIASES, ALIASES + 1):
            if (kx, ky) != (0, 0):
                gx, gy = fx + kx / pitch_m, fy + ky / pitch_m
                seen = (fx * gx + fy * gy) / f2 * np.sinc(pitch_m * gx) * np.sinc(pitch_m * gy)
                total += seen**2 * von_karman_nm2_m2(np.hypot(gx, gy), sky, facility)
    return total / (np.sinc(pitch_m * fx) * np.sinc(pitch_m * fy)) ** 2


class ResidualScreens:
    """Residual wavefronts from one moment to the next, without piston, tip and tilt over the pupil.

    Every Fourier mode is a complex first-order autoregressive process: its phase turns with the wind
    (frozen flow) and a part of it is replaced by noise (boiling), so its variance stays. The screen is
    real, hence only modes with fx >= 0 are kept.

    They are those of a `sky` over a `facility`, on the grid of `telescope`, drawn from `rng`.

    Raises `SceneError` if the fitting error alone exceeds the total residual.
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
        # Slow log-normal drift of the residual's size, with mean square 1; none for stationary skies.
        self._spread = np.sqrt(np.log1p(sky.drift_rms**2)) if sky.shape == "non_stationary" else 0.0
        self._strength = rng.standard_normal()

    def next_nm(self, step_s: float) -> np.ndarray:
        """Return the wavefront after one step of `step_s`, (n, n) float32 [nm]."""
        self.skip(step_s)
        screen = self._on_pupil(self._modes)
        if self._sky.variance_zernike:
            inside = np.where(self._in_band, self._modes, 0)
            screen = self._on_pupil(self._modes - inside) + self._local * self._on_pupil(inside)
        flat = screen.ravel() - (self._projector @ screen.ravel()) @ self._basis
        strength = np.exp(self._spread * self._strength - self._spread**2)
        return flat.reshape(self._n, self._n) * np.float32(strength)

    def _on_pupil(self, modes: np.ndarray) -> np.ndarray:
        periodic = scipy.fft.irfft2(modes, s=(self._size, self._size), norm="forward")
        return periodic[: self._n, : self._n]

    def skip(self, time_s: float) -> None:
        """Let `time_s` pass unobserved."""
        memory, fresh_nm = self._step(time_s)
        self._modes = self._modes * memory + fresh_nm * self._noise()
        kept = np.exp(-time_s / self._sky.drift_s)
        self._strength = kept * self._strength + np.sqrt(1 - kept**2) * self._rng.standard_normal()

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
        # how many modes of the whole plane a kept mode stands for; those at Nyquist's fx are left out
        stands_for = np.full(beyond.shape, 2.0)
        stands_for[:, 0] = 1.0
        if self._size % 2 == 0:
            stands_for[:, -1] = 0.0
        # part of every mode's variance over the pupil that is not piston, tip or tilt
        weighted = self._projector.reshape(3, self._n, self._n)
        spectra = scipy.fft.rfft2(weighted, s=(self._size, self._size))
        seen = stands_for * (1 - np.sum(np.abs(spectra) ** 2, axis=0))
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


def _piston_tip_tilt(telescope: Telescope) -> tuple[np.ndarray, np.ndarray]:
    """Piston, tip and tilt, orthonormal over the pupil, and the same weighted to project; (3, n²) each."""
    weight = (telescope.transmission / telescope.transmission.sum()).ravel()
    modes = np.array([telescope.mode(noll).ravel() for noll in (1, 2, 3)])
    basis = np.linalg.solve(np.linalg.cholesky((modes * weight) @ modes.T), modes)
    return basis.astype(np.float32), (basis * weight).astype(np.float32)
