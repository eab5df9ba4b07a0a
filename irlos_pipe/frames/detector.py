"""Detector calibration: from counts to electrons above the background, and the levels it needs."""

import numpy as np

from irlos_pipe.conventions.units import SIGMA_OF_MEDIAN
from irlos_pipe.frames.recording import Detector, sample_frames

WING_EXPONENT = 3.0  # the wings of a diffraction image fall like r^-3 on average
WING_START = 0.4  # of the larger window side: beyond it the core no longer matters
DARKEST_PERCENTILE = 1.0
CLIP_BAND = 0.02  # of the range of values: clipped pixels pile up on its very end
CLIP_EXCESS = 5
CLIP_MIN_PIXELS = 3
STANDS_STILL = 0.2  # variance along time over that along a side of the window
WRAP_ADU = 65536  # range of an integer of 16 bits
CLIP_MIN_LEVELS = 100.0  # ADU between darkest and brightest; fainter images repeat values by chance


def to_electrons(
    adu: np.ndarray, background_adu: np.ndarray, flat: np.ndarray, e_per_adu: float
) -> np.ndarray:
    """Convert counts to electrons above the background: ``(adu - background) / flat * e_per_adu``.

    `adu` (frames, rows, columns) are counts as recorded, `background_adu` (rows, columns) is dark, sky and
    pedestal together, `flat` (rows, columns) the relative response, 1 on average, and `e_per_adu` the gain.
    Returns float32 [e-]; values that are not finite stay so.
    """
    electrons = adu.astype(np.float32)
    electrons -= background_adu.astype(np.float32)
    electrons *= (e_per_adu / flat).astype(np.float32)
    return electrons


def relative_flat(flat: np.ndarray | None, window: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Normalise a `flat` (rows, columns) to a median of 1; None is a response of 1 all over the `window`.

    Returns the flat, 1 where it is unusable, and True where it is not a positive number; (rows, columns)
    each.
    """
    if flat is None:
        return np.ones(window), np.zeros(window, dtype=bool)
    bad = ~(np.isfinite(flat) & (flat > 0))
    if bad.all():
        return np.ones(window), bad
    return np.where(bad, 1.0, flat / np.median(flat[~bad])), bad


def estimate_pedestal(mean_adu: np.ndarray) -> tuple[float, float]:
    """Estimate the level on which a star stands, and its error, from the outer part of its mean image [ADU].

    A robust straight-line fit of ``level + slope * r^-3`` beyond `WING_START` of the window, not above the
    darkest pixels; the error is the difference between the two. The AO halo, flat over a small window, cannot
    be distinguished from a pedestal; the fits let the background of each frame free for that reason. Bad
    pixels of `mean_adu` (rows, columns) are NaN.
    """
    darkest = float(np.nanpercentile(mean_adu, DARKEST_PERCENTILE))
    y0, x0 = star_position(np.nan_to_num(mean_adu, nan=darkest))
    y, x = np.indices(mean_adu.shape)
    radius = np.hypot(y - y0, x - x0)
    outer = (radius > WING_START * max(mean_adu.shape)) & np.isfinite(mean_adu)
    if outer.sum() < 10:
        return darkest, 0.0
    level = _robust_intercept(radius[outer] ** -WING_EXPONENT, mean_adu[outer])
    return min(level, darkest), abs(darkest - level)


def _robust_intercept(x: np.ndarray, y: np.ndarray) -> float:
    """Intercept of a straight line fitted with Cauchy weights."""
    columns = np.stack([np.ones_like(x), x / x.max()], axis=1)
    weights = np.ones_like(y)
    for _ in range(20):
        root = np.sqrt(weights)
        coefficients, *_ = np.linalg.lstsq(columns * root[:, None], y * root, rcond=None)
        residual = y - columns @ coefficients
        scale = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(residual))), 1e-12)
        weights = 1 / (1 + (residual / scale) ** 2)
    return float(coefficients[0])


def star_position(image: np.ndarray) -> tuple[float, float]:
    """Return the centroid (row, column) of what stands above a tenth of the peak [px]."""
    above = image - np.median(image)
    weights = np.where(above > 0.1 * above.max(), above, 0.0)
    total = weights.sum()
    if total <= 0:
        return (image.shape[0] - 1) / 2, (image.shape[1] - 1) / 2
    y, x = np.indices(image.shape)
    return float((weights * y).sum() / total), float((weights * x).sum() / total)


def saturation_level(adu: np.ndarray, detector: Detector) -> float | None:
    """Return the raw level from which pixels of `adu` (frames, rows, columns) count as saturated [ADU].

    The `detector`'s own level if it is known; else the value on which far more pixels pile up than come close
    to it, or the end of an integer type; None if there is no sign of one.
    """
    if detector.saturation_adu is not None:
        return detector.saturation_adu
    integer = adu.dtype.kind in "iu"
    top, bottom = float(np.nanmax(adu)), float(np.nanmin(adu))
    if top - bottom > CLIP_MIN_LEVELS and _piles_up(adu, top, max(CLIP_BAND * (top - bottom), 5.0)):
        return top
    return float(np.iinfo(adu.dtype).max) if integer else None


def _piles_up(adu: np.ndarray, top: float, band_adu: float) -> bool:
    at_top = adu == top
    below = int(np.sum(adu >= top - band_adu)) - int(at_top.sum())
    # a single pixel that always reads the same is stuck, not saturated
    return at_top.sum() > CLIP_EXCESS * (below + 1) and at_top.any(axis=0).sum() >= CLIP_MIN_PIXELS


def wrapped_pixels(adu: np.ndarray) -> int:
    """Return in how many pixels counts (frames, rows, columns) have passed the end of an integer of 16 bits.

    They begin again at its other end. Optics that are sampled make no image that falls by half of the range
    from one pixel to the next, and a hot pixel is high by itself: three neighbours or more that are higher by
    as much surround a value that has overflowed. A single pixel may be dead, unless it is negative. Counts
    that 16 bits do not hold have not passed their end.
    """
    sample = adu[sample_frames(len(adu))].astype(np.float64)
    most = np.nanmax(sample)
    if min(sample.shape[1:]) < 3 or most >= WRAP_ADU or not most - np.nanmin(sample) > WRAP_ADU / 2:
        return 0
    padded = np.pad(sample, ((0, 0), (1, 1), (1, 1)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
    low = (around > sample[..., None, None] + WRAP_ADU / 2).sum(axis=(3, 4)) >= 3
    count = int(low.any(axis=0).sum())
    return count if count > 1 or (sample[low] < -WRAP_ADU / 8).any() else 0


def time_is_last(adu: np.ndarray) -> bool:
    """Return whether the last axis of counts, (frames, rows, columns) as declared, is that of the frames.

    Along time a star stands still but for noise and motion, along rows and columns its image ends.
    """
    if min(adu.shape) < 3 or adu.dtype == object:
        return False
    sample = adu[:, :, sample_frames(adu.shape[2])].astype(np.float64)
    return bool(sample.var(axis=2).mean() < STANDS_STILL * sample.var(axis=0).mean())
