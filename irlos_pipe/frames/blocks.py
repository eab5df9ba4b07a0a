"""Frames of a recording worked on in blocks: what is computed on the way does not grow with their number.

Sums over frames are taken in float64 block by block; with more than `BLOCK_FRAMES` frames they may differ
from a sum in one go by its rounding.
"""

from collections.abc import Iterator

import numpy as np

BLOCK_FRAMES = 256  # 8 MiB of float64 in a window of 64x64
SAMPLE_FRAMES = 200  # frames that suffice for statistics over time


def blocks(frames: int) -> Iterator[slice]:
    """Yield consecutive slices of at most `BLOCK_FRAMES` frames."""
    return (slice(start, start + BLOCK_FRAMES) for start in range(0, frames, BLOCK_FRAMES))


def sample_frames(frames: int, at_most: int = SAMPLE_FRAMES) -> np.ndarray:
    """Return indices of evenly spread ones of so many `frames`, `at_most` of them."""
    return np.unique(np.linspace(0, frames - 1, min(frames, at_most)).astype(int))


def picked(frames: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Return those of the `frames` that a mask says to `keep`, without a copy where all are kept."""
    return frames if keep.all() else frames[keep]


def mean_frame(images: np.ndarray) -> np.ndarray:
    """Return the mean of images (frames, rows, columns), float64."""
    total = sum(images[block].sum(axis=0, dtype=np.float64) for block in blocks(len(images)))
    return total / len(images)


def frame_variance(images: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the sample variance of two `images` or more (frames, rows, columns) about their `mean`."""
    with np.errstate(invalid="ignore"):  # of an infinite pixel: it is NaN
        squares = sum(np.square(images[block] - mean).sum(axis=0) for block in blocks(len(images)))
    return squares / (len(images) - 1)


def frame_flux(images_e: np.ndarray) -> np.ndarray:
    """Return the signal of each image (frames, rows, columns), summed over the window [e-]."""
    return images_e.sum(axis=(1, 2), dtype=np.float64)
