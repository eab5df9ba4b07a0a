"""Single pixels hit in single frames: cosmic rays, and whatever else spoils a pixel for a moment.

`images_e`, `good`, `sampling_px` and `noise` are those of `irlos_pipe.frames.bad_pixels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from irlos_pipe.frames.bad_pixels import Thresholds, deviant_pixels, optical_limit, without_bad_pixels
from irlos_pipe.frames.blocks import blocks, sample_frames
from irlos_pipe.frames.neighbour_prediction import Prediction, neighbour_prediction
from irlos_pipe.frames.noise import NoiseModel

ODD = 2.0  # times what noise and optics excuse: right frames reach 0.6, damaged rows of a frame 1 to 100


@dataclass(frozen=True)
class Hits:
    """Single pixels hit in single frames; three arrays of equal length."""

    frame: np.ndarray
    row: np.ndarray
    column: np.ndarray

    def per_pixel(self, window: tuple[int, int]) -> np.ndarray:
        """Return the number of frames in which each pixel of the window was hit, (rows, columns)."""
        counts = np.zeros(window, dtype=int)
        np.add.at(counts, (self.row, self.column), 1)
        return counts

    def outside(self, pixels: np.ndarray) -> Hits:
        """Return the hits on other pixels than `pixels` (rows, columns)."""
        keep = ~pixels[self.row, self.column]
        return Hits(self.frame[keep], self.row[keep], self.column[keep])

    def and_those(self, others: Hits) -> Hits:
        """Return these hits and `others`."""
        joined = (self.frame, others.frame), (self.row, others.row), (self.column, others.column)
        return Hits(*map(np.concatenate, joined))


NO_HITS = Hits(*np.empty((3, 0), dtype=int))


def cosmic_hits(
    images_e: np.ndarray,
    frames: np.ndarray,
    good: np.ndarray,
    sampling_px: float,
    noise: NoiseModel,
    thresholds: Thresholds,
) -> Hits:
    """Find pixels that jump in single frames.

    Parameters
    ----------
    images_e, good, sampling_px, noise
        See the module.
    frames : ndarray of int
        Indices of the frames to search.
    thresholds : Thresholds
        `sigma` and `fraction` are used.
    """
    prediction = neighbour_prediction(good, sampling_px)
    hits = [
        (frame, row, column)
        for frame in _suspicious_frames(images_e, frames, good, prediction, noise, thresholds)
        for row, column in np.argwhere(
            deviant_pixels(images_e[frame][None], good, sampling_px, noise, thresholds)
        )
    ]
    return Hits(*np.array(hits, dtype=int).reshape(-1, 3).T)


def odd_frames(
    images_e: np.ndarray,
    frames: np.ndarray,
    good: np.ndarray,
    core: np.ndarray,
    sampling_px: float,
    noise: NoiseModel,
    thresholds: Thresholds,
) -> np.ndarray:
    """Return which of the `frames` have detail that no light makes and the others lack, (frames,).

    A damaged row of one frame is such detail. What all frames have, as where the noise is told too small, is
    the fault of none. Pixels of the `core` (rows, columns) do not count: a star that moves beside clipped
    pixels breaks their usual relation, and what hits them is counted by itself. The other arguments are those
    of `cosmic_hits`, whose hits are no longer in the images.
    """
    prediction = neighbour_prediction(good, sampling_px)
    excess = _excess(images_e, frames, good & ~core, prediction, noise, thresholds)
    return excess > ODD * max(1.0, float(np.median(excess)))


def _suspicious_frames(
    images_e: np.ndarray,
    frames: np.ndarray,
    good: np.ndarray,
    prediction: Prediction,
    noise: NoiseModel,
    thresholds: Thresholds,
) -> list[int]:
    """Frames in which any good pixel leaves its usual relation to its neighbours by more than the limit."""
    return frames[_excess(images_e, frames, good, prediction, noise, thresholds) > 1].tolist()


def _excess(
    images_e: np.ndarray,
    frames: np.ndarray,
    counted: np.ndarray,
    prediction: Prediction,
    noise: NoiseModel,
    thresholds: Thresholds,
) -> np.ndarray:
    """By how much `counted` pixels leave their usual relation to neighbours: the most over the limit."""
    sample = images_e[frames[sample_frames(len(frames))]]
    usual = np.median(sample - prediction.of(sample), axis=0)
    mean = sample.mean(axis=0, dtype=np.float64)
    sigma = np.sqrt(prediction.variance(noise.variance_e2(mean)))
    limit = np.maximum(thresholds.sigma * sigma, optical_limit(prediction, mean, thresholds))
    most = []
    for block in blocks(len(frames)):
        searched = images_e[frames[block]]
        over = np.abs(searched - prediction.of(searched) - usual) / limit
        most.append(np.max(over, axis=(1, 2), where=counted, initial=0.0))
    return np.concatenate(most)


def flickering_pixels(hits: Hits, frames: int, window: tuple[int, int], fraction: float) -> np.ndarray:
    """Find pixels of the `window` that are hit too often to be unlucky, (rows, columns).

    Those are the pixels with `hits` in more than a `fraction` of so many `frames`, and in three at least.
    """
    return hits.per_pixel(window) > max(2, fraction * frames)


def without_hits(images_e: np.ndarray, hits: Hits, good: np.ndarray, sampling_px: float) -> np.ndarray:
    """Return `images_e` with the pixels of `hits` predicted from `good` ones of the same frame.

    The `sampling_px` is that of the module.
    """
    if hits.frame.size == 0:
        return images_e
    cleaned = images_e.copy()
    for frame in np.unique(hits.frame):
        hit = np.zeros(good.shape, dtype=bool)
        here = hits.frame == frame
        hit[hits.row[here], hits.column[here]] = True
        filled = without_bad_pixels(images_e[frame][None], good & ~hit, sampling_px)[0]
        cleaned[frame][hit] = filled[hit]
    return cleaned
