"""How many modes a cube supports: fit one half of the frames, predict the other half.

More modes always fit better what they were fitted to. Speckle and noise of one half say nothing
about the other, so the misfit of frames that no fit has seen falls only while modes describe the
static wavefront, and rises again when they follow chance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.conventions.modes import REPORTED_NOLLS
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames, mean_variance_e2
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
    so that both halves see the same slow changes. Raises ValueError with fewer than `MIN_FRAMES` frames.
    """
    if frames < MIN_FRAMES:
        raise ValueError(f"halves need at least {MIN_FRAMES} frames, there are {frames}")
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
    nolls: Sequence[int] = REPORTED_NOLLS,
    device: str = "cpu",
    report: Callable[[int], None] | None = None,
) -> ModeScan:
    """Calibrate either half of a cube with different numbers of modes.

    The numbers compared are `nolls`, from 2 on, in place of `highest_noll` of the `options`; `report` gets a
    1 after every fit. Other arguments are those of `calibrate`.
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
        tuple(nolls),
        np.array([[[one.get(noll, 0.0) for noll in nolls] for one in pair] for pair in given_nm]),
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
    report: Callable[[int], None] | None = None,
) -> list[Calibration]:
    """Return calibrations with different numbers of modes, in the order of `highest_nolls`.

    Every fit starts from that with the next larger number: a model that lacks modes easily falls into a wrong
    minimum, and this is not what is asked here. Other arguments are those of `scan_mode_numbers`.
    """
    fits: list[Calibration] = []
    for highest in reversed(highest_nolls):
        own, start_nm = replace(options, highest_noll=highest), fits[-1].zernike_nm if fits else None
        fits.append(calibrate(frames, settings, own, effects, start_nm=start_nm, device=device))
        if report:
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
