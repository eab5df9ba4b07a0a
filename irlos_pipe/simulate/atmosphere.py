"""AO residual: how large it is, and how its power is spread over spatial frequencies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.keys import key
from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.simulate.errors import SceneError, require_known

VON_KARMAN = 0.0229  # rad² m^(-11/3) r0^(-5/3)
SEEING_NM = 500.0
WIND_SCATTER = 0.3  # of the wind vectors of all layers about their mean, relative
ALIASING_SHARE = 0.6  # of the in-band variance of the shape `aliasing`; the rest is servo lag
ALIASES = 3  # folded bands on each side
Shape = Literal["power_law", "servo_lag", "aliasing", "non_stationary"]


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
        """Return the wind vector (x, y) [m/s]."""
        angle = np.deg2rad(self.wind_angle_deg)
        return self.wind_m_s * np.array([np.cos(angle), np.sin(angle)])

    def scaled(self, factor: float, law: ResidualLaw) -> Sky:
        """Return the `law`'s residual times `factor`; the fitting error grows as seeing^(5/6)."""
        total_nm = self.total_nm(law) * factor
        return replace(self, seeing_arcsec=self.seeing_arcsec * factor**1.2, wfe_nm=total_nm)


def residual_psd(
    fx: np.ndarray, fy: np.ndarray, sky: Sky, facility: Facility
) -> tuple[np.ndarray, np.ndarray]:
    """Return the power spectral densities inside and beyond the correction band.

    Parameters
    ----------
    fx, fy : ndarray, shapes that broadcast
        Spatial frequencies [1/m].
    sky : Sky
    facility : Facility
        Gives cut-off and outer scale.

    Returns
    -------
    inside : ndarray
        Up to a factor.
    beyond : ndarray
        The uncorrected turbulence [nm² m²].
    """
    fx, fy = np.broadcast_arrays(fx, fy)
    f = np.hypot(fx, fy)
    in_band, beyond_band = (f > 0) & (f < facility.cutoff_per_m), f >= facility.cutoff_per_m
    inside, beyond = np.zeros(f.shape), np.zeros(f.shape)
    inside[in_band] = _in_band(fx[in_band], fy[in_band], sky, facility)
    beyond[beyond_band] = von_karman_nm2_m2(f[beyond_band], sky, facility)
    return inside, beyond


def von_karman_nm2_m2(f_per_m: np.ndarray, sky: Sky, facility: Facility) -> np.ndarray:
    """Return the von Kármán spectrum of the uncorrected turbulence [nm² m²].

    ``0.0229 r0^(-5/3) (f² + L0^-2)^(-11/6)`` rad² m² with ``r0 = 0.976 λ / seeing`` (Roddier 1981).

    Parameters
    ----------
    f_per_m : ndarray
        Spatial frequencies [1/m].
    sky : Sky
        Gives the seeing.
    facility : Facility
        Gives the outer scale.
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
    """Return the spectrum of turbulence that moved on during the loop's delay [nm² m²].

    ``PSD = vK(f) q / (1 + q)`` with ``q = (2π τ)² <(f·v)²>``: for short delays the difference of the
    wavefront to its own shifted past, bounded by the turbulence itself. The mean over the layers'
    winds leaves something across the mean wind too.

    Parameters
    ----------
    fx, fy : ndarray
        Spatial frequencies [1/m].
    sky : Sky
    facility : Facility
    """
    along, f2 = fx * sky.wind[0] + fy * sky.wind[1], fx**2 + fy**2
    spread = (WIND_SCATTER * sky.wind_m_s) ** 2 * f2
    moved = (2 * np.pi * sky.delay_s) ** 2 * (along**2 + spread)
    return von_karman_nm2_m2(np.sqrt(f2), sky, facility) * moved / (1 + moved)


def aliasing_psd(fx: np.ndarray, fy: np.ndarray, sky: Sky, facility: Facility) -> np.ndarray:
    """Return the spectrum of turbulence that a Shack–Hartmann sensor takes for low frequencies [nm² m²].

    A sub-aperture of pitch d measures the gradient ``2πi f φ sinc(d fx) sinc(d fy)``. Sampled at d,
    the gradients at ``g = f + k/d`` appear at f, and the least-squares reconstructor returns
    ``φ(g) (f·g / f²) sinc(d g) / sinc(d f)`` for each k ≠ 0 (Rigaut et al. 1998; Jolissaint 2010).

    Parameters
    ----------
    fx, fy : ndarray
        Spatial frequencies [1/m].
    sky : Sky
    facility : Facility
        Gives the cut-off, and so the pitch.
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
