"""Standard deviation of NCPA modes and its law, ``std(i) = A exp(−B i) + C``, i = 0 for Noll 2.

A set of NCPAs is one draw of every mode, so several cubes with different NCPAs are needed for the
standard deviation of a mode, but one is enough for a law with three parameters. Its likelihood is
that of Gaussian draws of zero mean, ``a ~ N(0, std(i)² + noise²)``; for a mode with ν draws the sum
of squares over ν, s², is all that counts, and the deviance is ``ν (s²/v − 1 − ln(s²/v))``.

The law is that of the paper's appendix A, there fitted to the plain standard deviations.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.special import digamma

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import TIP_TILT

LIMITS = ((1e-2, 1e-3, 1e-3), (1e4, 3.0, 1e3))
SMALL_PART = 0.1  # part of C below which an exponential has vanished in the plateau
CURVATURE_STEP = 1e-3  # step of the logarithm of a parameter over which curvature is differentiated


@dataclass(frozen=True)
class ModeScatter:
    """How much the modes vary from one set of NCPAs to the next."""

    nolls: tuple[int, ...]
    std_nm: np.ndarray  # (modes,), RMS of the estimates over the cubes, about zero: the expected NCPA is none
    noise_nm: np.ndarray  # (modes,), part of it that is due to the errors of the estimates
    draws: int  # number of cubes, each with its own NCPAs

    @property
    def std_sigma_nm(self) -> np.ndarray:
        """Standard error of `std_nm` for Gaussian draws."""
        return self.std_nm / np.sqrt(2 * self.draws)


@dataclass(frozen=True)
class ModeLaw:
    """A fitted law; A, B and C are `a_nm`, `decay` and `plateau_nm`."""

    a_nm: float
    decay: float
    plateau_nm: float
    covariance: np.ndarray  # (3, 3), of (ln A, ln B, ln C)
    deviance_nu: float  # deviance over what draws from the law would give; near 1 where it holds

    @property
    def sigma(self) -> tuple[float, float, float]:
        """Standard errors of A, B and C; a plateau that the data do not need has one larger than itself."""
        values = (self.a_nm, self.decay, self.plateau_nm)
        return tuple(v * s for v, s in zip(values, np.sqrt(np.diag(self.covariance)), strict=True))

    @property
    def plateau_noll(self) -> int:
        """Mode from which the exponential is below a tenth of the plateau."""
        steps = np.log(self.a_nm / (SMALL_PART * self.plateau_nm)) / self.decay
        return 2 + max(0, int(np.ceil(steps)))

    def __call__(self, nolls: Sequence[int]) -> np.ndarray:
        """Standard deviation of modes [nm]."""
        return _law(np.log([self.a_nm, self.decay, self.plateau_nm]), nolls)


def mode_scatter(nolls: Sequence[int], zernike_nm: np.ndarray, sigma_nm: np.ndarray) -> ModeScatter:
    """Measure the scatter of estimates and their errors (cubes, modes), one row per set of NCPAs."""
    return ModeScatter(
        tuple(nolls),
        np.sqrt(np.mean(np.square(zernike_nm), axis=0)),
        np.sqrt(np.mean(np.square(sigma_nm), axis=0)),
        len(zernike_nm),
    )


def equalised_tilts(scatter: ModeScatter) -> ModeScatter:
    """Give tip and tilt their common standard deviation, as in the paper."""
    tilts = np.isin(scatter.nolls, TIP_TILT)

    def equal(values: np.ndarray) -> np.ndarray:
        return np.where(tilts, np.sqrt(np.mean(values[tilts] ** 2)) if tilts.any() else 0.0, values)

    return ModeScatter(scatter.nolls, equal(scatter.std_nm), equal(scatter.noise_nm), scatter.draws)


def fit_mode_law(scatter: ModeScatter, keep: np.ndarray, start: NcpaLaw, *, remove_noise: bool) -> ModeLaw:
    """Fit the law by maximum likelihood to the modes to `keep`, (modes,) of bool.

    The search begins at `start`. With `remove_noise`, the law is that of the NCPAs, the noise in the
    likelihood; otherwise that of the estimates. Raises ValueError with fewer than four modes.
    """
    nolls = np.asarray(scatter.nolls)[keep]
    if len(nolls) < 4:
        raise ValueError(f"a law of three parameters needs at least four modes, there are {len(nolls)}")
    noise2 = scatter.noise_nm[keep] ** 2 if remove_noise else np.zeros(len(nolls))

    def root_deviance(x: np.ndarray) -> np.ndarray:
        ratio = scatter.std_nm[keep] ** 2 / (_law(x, nolls) ** 2 + noise2)
        deviance = scatter.draws * (ratio - 1 - np.log(ratio))
        return np.sign(ratio - 1) * np.sqrt(np.maximum(deviance, 0))

    low, high = np.log(LIMITS)
    fit = least_squares(
        root_deviance,
        np.log([start.amplitude_nm, start.decay, start.plateau_nm]),
        bounds=(low, high),
        x_scale=0.1,
    )

    def log_variance(x: np.ndarray) -> np.ndarray:
        return np.log(_law(x, nolls) ** 2 + noise2)

    # Fisher information of the logarithms of A, B, C: ``ν/2 Σ ∂ln v ∂ln vᵀ``, (3, 3)
    steps = CURVATURE_STEP * np.eye(3)
    slopes = np.array([log_variance(fit.x + step) - log_variance(fit.x - step) for step in steps])
    slopes /= 2 * CURVATURE_STEP
    covariance = np.linalg.pinv(scatter.draws / 2 * slopes @ slopes.T)
    # of one mode's deviance 1.27 for one draw, 1 for many; from ``E ln χ²_ν``
    expected = scatter.draws * (np.log(scatter.draws / 2) - digamma(scatter.draws / 2)) * (len(nolls) - 3)
    a_nm, decay, plateau_nm = np.exp(fit.x)
    return ModeLaw(a_nm, decay, plateau_nm, covariance, float(np.sum(fit.fun**2) / expected))


def _law(x: np.ndarray, nolls: Sequence[int] | np.ndarray) -> np.ndarray:
    """The law for the logarithms of A, B and C."""
    a, b, c = np.exp(x)
    return a * np.exp(-b * (np.asarray(nolls) - 2)) + c
