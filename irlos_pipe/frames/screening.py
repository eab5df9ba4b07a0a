"""Which frames of a recording can be used, and why the others cannot; which values of them are wrong.

Single pixels are wrong in single frames where cosmic rays hit them, or where they are clipped. A detector
whose pixels respond unequally, and whose frames were divided by a flat or recentred, has no common level of
saturation. A clipped pixel shows by the company of its values: they lie together much closer than the noise
of the photons would let them. For these `images_e`, `good` and `by` are those of `frames.bad_pixels`.
"""

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from irlos_pipe.conventions.units import SIGMA_OF_MEDIAN
from irlos_pipe.frames.bad_pixels import Criteria, deviant_pixels, optical_limit
from irlos_pipe.frames.noise import MIN_FRAMES_FOR_NOISE
from irlos_pipe.frames.recording import blocks, frame_flux, mean_frame, picked, sample_frames

EXCUSED = 2.0  # times what noise and optics excuse: intact frames reach 0.6, damaged rows of a frame 1 to 100
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
    return excess > EXCUSED * max(1.0, float(np.median(excess)))


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


REPEATED_COUNTER = "frame counter repeated"
REPEATED_IMAGE = "image repeated"
NOT_FINITE = "values not finite"
EMPTY = "empty frame"
SATURATED = "saturated"
NO_STAR = "no star above the noise"
AT_EDGE = "star at the edge of the window"
COMBINED = "mean or sum of other frames"
FLUX = "flux outlier"
COSMIC = "cosmic hit in the core"
ODD = "detail finer than the optics make"
REASON_TYPE = "<U40"
MIN_FRAMES_FOR_FLUX = 5
MIN_FRAMES_TO_COMBINE = 3
SMALLEST_SQUARE = 6  # side of the smallest square that a spread star fills [px]
FINE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # along both axes: leaves what is finer than 3 pixels
COMBINED_VARIANCE = 0.25  # variance over that of the others: the mean of five or more frames has less


@dataclass(frozen=True)
class Limits:
    """Limits beyond which a frame is not used, by their keys in a recipe."""

    max_saturated_px: int  # saturated pixels that are tolerated
    min_star_snr: float  # peak of the star over the noise, both after averaging over 3x3 pixels
    min_edge_px: float  # distance of the star from the edge of the window [px]
    # deviation from the median flux over its robust scatter, and over the median; both must be exceeded
    flux_sigma: float
    flux_fraction: float
    core_fraction: float  # pixels brighter than this fraction of the peak are the core
    max_core_hits_px: int  # hit pixels of the core that are tolerated; their neighbours determine so few


def no_reasons(frames: int) -> np.ndarray:
    """Return the reasons of so many `frames` without a fault, (frames,)."""
    return np.full(frames, "", dtype=REASON_TYPE)


def also(reasons: np.ndarray, wrong: np.ndarray, reason: str) -> np.ndarray:
    """Return `reasons` with `reason` for the frames in the mask `wrong` that have none yet, (frames,)."""
    return np.where((reasons == "") & wrong, reason, reasons).astype(REASON_TYPE)


def tally(reasons: np.ndarray) -> dict[str, int]:
    """Return the number of frames per reason, the most frequent first."""
    return dict(Counter(reasons[reasons != ""].tolist()).most_common())


def recorder_faults(adu: np.ndarray, frame_counter: np.ndarray) -> np.ndarray:
    """Find frames that the recorder delivered twice, empty or with values that are no numbers.

    Returns the reasons by counts `adu` (frames, rows, columns) and `frame_counter` (frames,), empty for
    frames without a fault. A pixel that is not finite in most frames is a bad pixel and does not count.
    """
    frames = adu.reshape(len(adu), -1)
    finite = np.isfinite(frames)
    often = finite.mean(axis=0) > 0.5
    seen_before = np.ones(len(adu), dtype=bool)
    seen_before[np.unique(frame_counter, return_index=True)[1]] = False
    reasons = also(no_reasons(len(adu)), seen_before, REPEATED_COUNTER)
    reasons = also(reasons, ~finite[:, often].all(axis=1) | ~often.any(), NOT_FINITE)
    reasons = also(reasons, frames.max(axis=1) == frames.min(axis=1), EMPTY)
    return also(reasons, np.r_[False, (frames[1:] == frames[:-1]).all(axis=1)], REPEATED_IMAGE)


def saturated_frames(
    adu: np.ndarray, good: np.ndarray, level_adu: float | None, tolerated_px: int
) -> np.ndarray:
    """Return which frames of `adu` have more than `tolerated_px` saturated pixels, (frames,).

    Pixels that are not `good` do not count; `level_adu` is the lowest saturated count, None if not known.
    """
    if level_adu is None:
        return np.zeros(len(adu), dtype=bool)
    return ((adu >= level_adu) & good).sum(axis=(1, 2)) > tolerated_px


class StarPeak(NamedTuple):
    """Brightest spot of each image after averaging over 3x3 pixels; arrays (frames,)."""

    snr: np.ndarray  # height above the median over the robust scatter of the image
    edge_px: np.ndarray  # distance from the nearest edge of the window [px]


def star_peaks(images_e: np.ndarray) -> StarPeak:
    """Find the brightest spot of each image (frames, rows, columns)."""
    found = (_peaks(images_e[block]) for block in blocks(len(images_e)))
    return StarPeak(*map(np.concatenate, zip(*found, strict=True)))


def _peaks(images_e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = images_e.shape[1:]
    smooth = scipy.ndimage.uniform_filter(images_e, size=(0, 3, 3), mode="nearest").reshape(len(images_e), -1)
    above = smooth - np.median(smooth, axis=1, keepdims=True)
    scatter = SIGMA_OF_MEDIAN * np.median(np.abs(above), axis=1)
    y, x = np.unravel_index(smooth.argmax(axis=1), (rows, columns))
    edge = np.minimum.reduce([y, rows - 1 - y, x, columns - 1 - x])
    return above.max(axis=1) / np.maximum(scatter, 1e-9), edge


def spread_stars(images_e: np.ndarray, least_snr: float) -> np.ndarray:
    """Find the images (frames, rows, columns) of a star whose light is spread over many pixels, (frames,).

    As of a star far out of focus. In a square, on one of several scales, the flux over what surrounds it
    within twice its side is at least `least_snr` times the noise of this difference; a gradient cancels.
    """
    found = np.zeros(len(images_e), dtype=bool)
    for place, image in enumerate(images_e.astype(np.float64)):
        fine = both_ways(image, FINE)
        fine = fine[np.isfinite(fine)]
        noise = SIGMA_OF_MEDIAN * np.median(np.abs(fine)) / np.sum(FINE**2) if fine.size else np.inf
        side = SMALLEST_SQUARE
        while 2 * side <= min(image.shape) and not found[place]:
            inner, both = (
                scipy.ndimage.uniform_filter(image, size)[side:-side, side:-side] for size in (side, 2 * side)
            )
            above = (inner - both).max(initial=0.0) * 4 / 3
            found[place] = above > 0 and above * side >= least_snr * noise * np.sqrt(4 / 3)
            side *= 2
    return found


def star_faults(
    images_e: np.ndarray, reasons: np.ndarray, limits: Limits, plane: np.ndarray | None = None
) -> np.ndarray:
    """Add frames without the star, with the star about to leave the window, made of others, or of odd flux.

    If not even the median of the frames shows a star, none of them can be used. Single frames are asked for a
    star only where the star is normally plain to see. The `images_e` are finite, `reasons` what is known so
    far, (frames,), and `limits` what a usable frame has to keep. Frames of another `plane` of focus (frames,)
    lose other light at the edge of the window: their flux is not compared.
    """
    used = np.flatnonzero(reasons == "")
    if used.size == 0:
        return reasons
    typical = np.median(images_e[used[sample_frames(len(used))]], axis=0)
    bright = star_peaks(typical[None]).snr[0] >= limits.min_star_snr
    if not (bright or spread_stars(typical[None], limits.min_star_snr)[0]):
        return also(reasons, np.ones(len(reasons), dtype=bool), NO_STAR)
    peaks = star_peaks(images_e)
    if np.median(peaks.snr[used]) > 2 * limits.min_star_snr:
        doubtful = (peaks.snr < limits.min_star_snr) | (peaks.edge_px < limits.min_edge_px)
        doubtful[doubtful] = ~spread_stars(images_e[doubtful], limits.min_star_snr)
        reasons = also(reasons, doubtful & (peaks.snr < limits.min_star_snr), NO_STAR)
        reasons = also(reasons, doubtful, AT_EDGE)
    reasons = also(reasons, combined_frames(images_e, reasons == ""), COMBINED)
    flux_e, planes = frame_flux(images_e), np.zeros(len(reasons)) if plane is None else plane
    for own in (planes == one for one in np.unique(planes)):
        reasons = also(reasons, own & flux_outliers(flux_e, own & (reasons == ""), limits), FLUX)
    return reasons


def combined_frames(images_e: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return which frames are the mean or the sum of others, as some recorders add one to a cube, (frames,).

    Their noise is that of the others: little is left when the mean of these, as bright as the frame, is
    subtracted, while an exposure keeps its own noise. Only what is finer than the optics make counts, in the
    fainter half of the window, so that speckles and image motion do not. The `images_e` are finite, `used`
    (frames,) those that may be combined.
    """
    found = np.zeros(len(images_e), dtype=bool)
    numbers = np.flatnonzero(used)
    if len(numbers) < MIN_FRAMES_TO_COMBINE or min(images_e.shape[1:]) < 2 * len(FINE):
        return found
    mean = mean_frame(picked(images_e, used))
    faint = mean <= np.median(mean)
    left = np.empty(len(numbers))
    for place, number in enumerate(numbers):
        image = images_e[number].astype(np.float64)
        others = mean + (mean - image) / (len(numbers) - 1)
        star = others - np.median(others)
        part = float(np.sum(star * image) / np.sum(star**2))
        left[place] = np.nanvar(both_ways(image - part * others, FINE)[faint]) / min(1.0, part) ** 2
    found[numbers] = left < COMBINED_VARIANCE * np.median(left)
    return found


def flux_outliers(flux_e: np.ndarray, used: np.ndarray, limits: Limits) -> np.ndarray:
    """Return which frames have a flux that differs from the median by more than both `limits`, (frames,).

    `flux_e` (frames,) is the sum over the window; `used` frames (frames,) count for median and scatter.
    """
    if used.sum() < MIN_FRAMES_FOR_FLUX:
        return np.zeros(len(flux_e), dtype=bool)
    median = np.median(flux_e[used])
    deviation = np.abs(flux_e - median)
    scatter = SIGMA_OF_MEDIAN * np.median(deviation[used])
    return (deviation > limits.flux_sigma * scatter) & (deviation > limits.flux_fraction * abs(median))


def core_of(mean_e: np.ndarray, limits: Limits) -> np.ndarray:
    """Return the core of the star in a mean image: pixels brighter than `core_fraction` of its peak."""
    return mean_e > limits.core_fraction * mean_e.max()


def hit_in_core(hits: Hits, core: np.ndarray, frames: int, limits: Limits) -> np.ndarray:
    """Return which of so many `frames` have more `hits` in the `core` of the star than `limits` tolerates."""
    in_core = core[hits.row, hits.column]
    return np.bincount(hits.frame[in_core], minlength=frames) > limits.max_core_hits_px


def both_ways(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Return the convolution of an `image` with a `kernel` along rows and columns; NaN near edges and NaN."""
    for axis in (0, 1):
        image = scipy.ndimage.convolve1d(image, kernel, axis=axis, mode="constant", cval=np.nan)
    return image
