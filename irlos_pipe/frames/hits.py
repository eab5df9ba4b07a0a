"""Values of single pixels that are wrong in single frames: hits of cosmic rays, and clipped ones.

`images_e`, `good` and `by` are those of `irlos_pipe.frames.bad_pixels`.

A detector whose pixels respond unequally, and whose frames were divided by a flat or recentred, has no common
level of saturation. A clipped pixel shows by the company of its values: they lie together much closer than
the noise of the photons would let them.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from irlos_pipe.frames.bad_pixels import Criteria, deviant_pixels, optical_limit
from irlos_pipe.frames.blocks import blocks, sample_frames
from irlos_pipe.frames.noise import MIN_FRAMES_FOR_NOISE

ODD = 2.0  # times what noise and optics excuse: intact frames reach 0.6, damaged rows of a frame 1 to 100
BRIGHT = 0.5  # part of the peak: what is fainter is not clipped while the peak grows
FALSE_ALARM = 1e-6  # chance that the values of a good pixel lie together as close
WIDTHS = ((0.1, 1.0), (0.5, 4.0))  # in sigma: how close values are, among those how far around


@dataclass(frozen=True)
class Hits:
    """Single pixels hit in single frames; three arrays of equal length."""

    frame: np.ndarray
    row: np.ndarray
    column: np.ndarray

    def outside(self, pixels: np.ndarray) -> "Hits":
        """Return the hits on other pixels than `pixels` (rows, columns)."""
        keep = ~pixels[self.row, self.column]
        return Hits(self.frame[keep], self.row[keep], self.column[keep])

    def and_those(self, others: "Hits") -> "Hits":
        joined = (self.frame, others.frame), (self.row, others.row), (self.column, others.column)
        return Hits(*map(np.concatenate, joined))


NO_HITS = Hits(*np.empty((3, 0), dtype=int))


def cosmic_hits(images_e: np.ndarray, frames: np.ndarray, good: np.ndarray, by: Criteria) -> Hits:
    """Find pixels that jump in single ones of the `frames`, by their indices among `images_e`.

    The arguments `images_e`, `good` and `by` are those of the module.
    """
    suspicious = frames[_excess(images_e, frames, good, by) > 1].tolist()
    hits = [
        (frame, row, column)
        for frame in suspicious
        for row, column in np.argwhere(deviant_pixels(images_e[frame][None], good, by))
    ]
    return Hits(*np.array(hits, dtype=int).reshape(-1, 3).T)


def odd_frames(
    images_e: np.ndarray, frames: np.ndarray, good: np.ndarray, core: np.ndarray, by: Criteria
) -> np.ndarray:
    """Return which of the `frames` have detail that no light makes and the others lack, (frames,).

    A damaged row of one frame is such detail. What all frames have, as where the noise is declared too small,
    is the fault of none. Pixels of the `core` (rows, columns) do not count: a star that moves next to clipped
    pixels breaks their usual relation, and what hits them is counted by itself. The arguments `images_e`,
    `good` and `by` are those of `cosmic_hits`, whose hits are no longer in the images.
    """
    excess = _excess(images_e, frames, good, by, core)
    return excess > ODD * max(1.0, float(np.median(excess)))


def _excess(
    images_e: np.ndarray, frames: np.ndarray, good: np.ndarray, by: Criteria, core: np.ndarray | None = None
) -> np.ndarray:
    """By how much good pixels outside the core leave their usual relation to neighbours, over the limit."""
    prediction, counted = by.prediction(good), good if core is None else good & ~core
    sample = images_e[frames[sample_frames(len(frames))]]
    usual = np.median(sample - prediction.of(sample), axis=0)
    mean = sample.mean(axis=0, dtype=np.float64)
    sigma = np.sqrt(prediction.variance(by.noise.variance_e2(mean)))
    limit = np.maximum(by.thresholds.bad_pixel_sigma * sigma, optical_limit(prediction, mean, by.thresholds))
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
    counts = np.zeros(window, dtype=int)
    np.add.at(counts, (hits.row, hits.column), 1)
    return counts > max(2, fraction * frames)


def without_hits(images_e: np.ndarray, hits: Hits, good: np.ndarray, by: Criteria) -> np.ndarray:
    """Return `images_e` with the pixels of `hits` predicted from `good` ones of the same frame, see `by`."""
    if hits.frame.size == 0:
        return images_e
    cleaned = images_e.copy()
    for frame in np.unique(hits.frame):
        hit = np.zeros(good.shape, dtype=bool)
        here = hits.frame == frame
        hit[hits.row[here], hits.column[here]] = True
        filled = by.filled(images_e[frame][None], good & ~hit)[0]
        cleaned[frame][hit] = filled[hit]
    return cleaned


def clipped_samples(images: np.ndarray, good: np.ndarray, sigma: np.ndarray, step: float) -> np.ndarray:
    """Find values of bright pixels that recur from frame to frame more closely than noise permits.

    For every value the number of others within a fraction of the noise is compared with the number in a wider
    surrounding; normal noise alone, or any wider distribution, keeps the first to a known share. The `images`
    (frames, rows, columns) are finite, on any linear scale, and searched where pixels are `good`; `sigma`
    (rows, columns) is the noise of a value on the same scale, not more than the true one, and `step` that of
    the digitisation, 0 if there is none: where it rivals the closeness, equal values mean nothing. Returns
    (frames, rows, columns), all False with fewer than `MIN_FRAMES_FOR_NOISE` frames.
    """
    clipped = np.zeros(images.shape, dtype=bool)
    if len(images) < MIN_FRAMES_FOR_NOISE or not good.any():
        return clipped
    typical = np.where(good, np.median(images, axis=0), -np.inf)
    bright = typical > BRIGHT * typical.max()
    values = images[:, bright].astype(np.float64)
    noise = np.broadcast_to(sigma[bright], values.shape)
    own = np.stack([_piled_up(*one, step) for one in zip(values.T, noise.T, strict=True)], axis=1)
    # a recording that was recentred shows the level of one pixel of the detector in several of its own
    together = _piled_up(values.ravel(), noise.ravel(), step).reshape(values.shape)
    clipped[:, bright] = own | together
    return clipped


def _piled_up(values: np.ndarray, sigma: np.ndarray, step: float) -> np.ndarray:
    found = np.zeros(len(values), dtype=bool)
    for close, wide in WIDTHS:
        near, around = (_others_within(values, width * sigma) for width in (close, wide))
        # of normal values about their own mean; any wider distribution has a smaller share
        share = scipy.special.erf(close / np.sqrt(2)) / scipy.special.erf(wide / np.sqrt(2))
        by_chance = scipy.special.bdtrc(near - 1, around, share)  # that as many or more are near
        found |= (by_chance < FALSE_ALARM) & (close * sigma > 2 * step)
    return found


def _others_within(values: np.ndarray, distance: np.ndarray) -> np.ndarray:
    ordered = np.sort(values)
    below = np.searchsorted(ordered, values - distance, side="left")
    above = np.searchsorted(ordered, values + distance, side="right")
    return above - below - 1
