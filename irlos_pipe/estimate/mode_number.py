"""How many modes a cube supports: fit one half of the frames, predict the other half.

More modes always fit better what they were fitted to. Speckle and noise of one half say nothing
about the other, so the misfit of frames that no fit has seen falls only while modes describe the
static wavefront, and rises again when they follow chance.

Standard deviation of NCPA modes and its law, ``std(i) = A exp(−B i) + C``, i = 0 for Noll 2.

A set of NCPAs is one draw of every mode, so several cubes with different NCPAs are needed for the
standard deviation of a mode, but one is enough for a law with three parameters. Its likelihood is
that of Gaussian draws of zero mean, ``a ~ N(0, std(i)² + noise²)``; for a mode with ν draws the sum
of squares over ν, s², is all that counts, and the deviance is ``ν (s²/v − 1 − ln(s²/v))``.

The law is that of the paper's appendix A, there fitted to the plain standard deviations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.special import digamma

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import REPORTED_NOLLS, TIP_TILT
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames, mean_variance_e2
from irlos_pipe.estimate.methods import Report, silent
from irlos_pipe.optics.psf_settings import PsfSettings

BLOCKS_PER_HALF = 8
MIN_FRAMES = 4 * BLOCKS_PER_HALF


@dataclass(frozen=True)
class ModeScan:
    """Estimates of one cube with different numbers of modes."""

    highest_nolls: tuple[int, ...]  # modes Noll 2 to this were estimated
    nolls: tuple[int, ...]  # modes that are compared
    zernike_nm: np.ndarray  # (numbers, 2, modes), from either half; 0 for modes that were not estimated
    # (numbers, blocks), χ²/ν of the mean image of every block of frames against the model of the other half
    misfit: np.ndarray
    fitted_chi2_nu: np.ndarray  # (numbers,), of the images that were fitted, mean over the halves

    @property
    def mean_nm(self) -> np.ndarray:
        """Mean of the halves, (numbers, modes)."""
        return self.zernike_nm.mean(axis=1)

    @property
    def halves_nm(self) -> np.ndarray:
        """Error of the mean from the difference of the halves: half of its RMS, (numbers,)."""
        return np.sqrt(np.sum((self.zernike_nm[:, 0] - self.zernike_nm[:, 1]) ** 2, axis=1)) / 2


@dataclass(frozen=True)
class Choice:
    """The recommended number of modes."""

    best: int  # place of the least misfit
    recommended: int  # place of the smallest number whose misfit is not significantly larger
    excess: np.ndarray  # (numbers,), misfit above the least one
    excess_sigma: np.ndarray  # (numbers,), standard error of this difference


def halves(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the frames of two halves, each (blocks, frames): alternate runs of equal length.

    Runs rather than single frames, whose speckle is correlated with that of their neighbours; many of them,
    so that both halves see the same slow changes. There are `MIN_FRAMES` frames at least.
    """
    length = frames // (2 * BLOCKS_PER_HALF)
    runs = np.arange(2 * BLOCKS_PER_HALF * length).reshape(-1, length)
    return runs[0::2], runs[1::2]


def scan_mode_numbers(
    frames: Frames,
    settings: PsfSettings,
    options: CalibrationOptions,
    highest_nolls: Sequence[int],
    effects: Sequence[Effect] = (),
    *,
    device: str = "cpu",
    report: Report = silent,
) -> ModeScan:
    """Calibrate either half of a cube with different numbers of modes.

    These are `highest_nolls`, in place of that of the `options`; `report` gets a 1 after every fit. Other
    arguments are those of `calibrate`.
    """
    one, other = halves(len(frames.images_e))
    fits = [
        fit_mode_numbers(
            _of(frames, half), settings, options, highest_nolls, effects, device=device, report=report
        )
        for half in (one, other)
    ]
    misfit = [
        np.concatenate([held_out_misfit(frames, of_one, other), held_out_misfit(frames, of_other, one)])
        for of_one, of_other in zip(*fits, strict=True)
    ]
    given_nm = [
        [dict(zip(fit.nolls, fit.zernike_nm, strict=True)) for fit in pair]
        for pair in zip(*fits, strict=True)
    ]
    return ModeScan(
        tuple(highest_nolls),
        REPORTED_NOLLS,
        np.array([[[one.get(noll, 0.0) for noll in REPORTED_NOLLS] for one in pair] for pair in given_nm]),
        np.array(misfit),
        np.mean([[fit.chi2_nu for fit in half] for half in fits], axis=0),
    )


def fit_mode_numbers(
    frames: Frames,
    settings: PsfSettings,
    options: CalibrationOptions,
    highest_nolls: Sequence[int],
    effects: Sequence[Effect] = (),
    *,
    device: str = "cpu",
    report: Report = silent,
) -> list[Calibration]:
    """Return calibrations with different numbers of modes, in the order of `highest_nolls`.

    Every fit starts from that with the next larger number: a model that lacks modes easily falls into a wrong
    minimum, and this is not what is asked here. Other arguments are those of `scan_mode_numbers`.
    """
    fits: list[Calibration] = []
    for highest in reversed(highest_nolls):
        own, start_nm = replace(options, highest_noll=highest), fits[-1].zernike_nm if fits else None
        fits.append(calibrate(frames, settings, own, effects, start_nm=start_nm, device=device))
        report(1)
    return fits[::-1]


def held_out_misfit(frames: Frames, fit: Calibration, unseen: np.ndarray) -> np.ndarray:
    """Return χ²/ν of blocks of frames, `unseen` (blocks, frames), against the model of others, (blocks,).

    Flux and background of a block are its own: they change and say nothing about the modes.
    """
    good = frames.good.numpy()
    half = _of(frames, unseen)
    changing = mean_variance_e2(half) - half.noise.shared_e2  # both halves share the rest
    sigma = (len(unseen) * changing).sqrt().numpy()[good]
    model = fit.model_image_e[good]
    design = np.stack([model, np.ones_like(model)], axis=1) / sigma[:, None]
    blocks = half.images_e.reshape(*unseen.shape, *good.shape).double().mean(1).numpy()
    whitened = blocks[:, good] / sigma
    left = whitened - whitened @ np.linalg.pinv(design).T @ design.T
    return np.mean(left**2, axis=1)


def _of(frames: Frames, numbers: np.ndarray) -> Frames:
    return replace(frames, images_e=frames.images_e[torch.as_tensor(numbers.ravel())])


def choose(misfit: np.ndarray) -> Choice:
    """Take the smallest number whose held-out misfit is within its error of the least one.

    The `misfit` (numbers, blocks) is in the order of rising numbers; blocks of several cubes may stand side
    by side. Differences of the same block are compared, so that what all numbers share falls out.
    """
    best = int(np.argmin(misfit.mean(axis=1)))
    difference = misfit - misfit[best]
    excess = difference.mean(axis=1)
    sigma = difference.std(axis=1, ddof=1) / np.sqrt(misfit.shape[1])
    return Choice(best, int(np.argmax(excess <= sigma)), excess, sigma)


LIMITS = ((1e-2, 1e-3, 1e-3), (1e4, 3.0, 1e3))
SMALL_PART = 0.1  # part of C below which an exponential has vanished in the plateau


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

    return replace(scatter, std_nm=equal(scatter.std_nm), noise_nm=equal(scatter.noise_nm))


def fit_mode_law(scatter: ModeScatter, keep: np.ndarray, start: NcpaLaw, *, remove_noise: bool) -> ModeLaw:
    """Fit the law by maximum likelihood to the modes to `keep`, (modes,) of bool.

    The search begins at `start`. With `remove_noise`, the law is that of the NCPAs, the noise in the
    likelihood; otherwise that of the estimates.
    """
    nolls = np.asarray(scatter.nolls)[keep]
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

    # Fisher information of the logarithms of A, B, C: ``ν/2 Σ ∂ln v ∂ln vᵀ``, (3, 3)
    a_nm, decay, plateau_nm = np.exp(fit.x)
    std = _law(fit.x, nolls)
    falling = std - plateau_nm
    slopes = np.stack([falling, -decay * (nolls - 2) * falling, np.full(len(nolls), plateau_nm)])
    slopes *= 2 * std / (std**2 + noise2)
    covariance = np.linalg.pinv(scatter.draws / 2 * slopes @ slopes.T)
    # of one mode's deviance 1.27 for one draw, 1 for many; from ``E ln χ²_ν``
    expected = scatter.draws * (np.log(scatter.draws / 2) - digamma(scatter.draws / 2)) * (len(nolls) - 3)
    return ModeLaw(a_nm, decay, plateau_nm, covariance, float(np.sum(fit.fun**2) / expected))


def _law(x: np.ndarray, nolls: Sequence[int] | np.ndarray) -> np.ndarray:
    """The law for the logarithms of A, B and C."""
    a, b, c = np.exp(x)
    return a * np.exp(-b * (np.asarray(nolls) - 2)) + c
