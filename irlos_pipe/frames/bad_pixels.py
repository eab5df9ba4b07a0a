"""Bad pixels and cosmic hits, recognised by what they do over time and between neighbours.

Throughout, `images_e` are finite images (frames, rows, columns) [e-], `good` (rows, columns) is True for
pixels not known to be bad, `sampling_px` is the number of pixels per λ/D at the shortest wavelength, and
`noise` the declared noise of photons and read-out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, median_filter
from scipy.stats import chi2

from irlos_pipe.frames.blocks import SAMPLE_FRAMES, blocks, sample_frames
from irlos_pipe.frames.neighbour_prediction import Prediction, neighbour_prediction
from irlos_pipe.frames.noise import MIN_FRAMES_FOR_NOISE, NoiseModel
from irlos_pipe.frames.recording import Detector

FALSE_ALARM = 1e-4  # chance that statistics alone make one good pixel of the window look stuck
HOT_OVER_PATTERN = 20.0  # sigma of the dark's own pattern, which may be a bias without shot noise
MAX_ROUNDS = 60


@dataclass(frozen=True)
class Thresholds:
    """Limits beyond which a pixel counts as bad.

    Attributes
    ----------
    sigma : float
        Deviation from the neighbours over the noise.
    fraction : float
        Deviation from the neighbours over their own brightness; both must be exceeded.
    stuck_ratio : float
        Scatter over time of a stuck pixel over the read noise.
    noisy_ratio : float
        Scatter of a noisy pixel over the scatter expected.
    flicker_fraction : float
        Fraction of the frames in which a pixel may be hit before it counts as bad.
    """

    sigma: float
    fraction: float
    stuck_ratio: float
    noisy_ratio: float
    flicker_fraction: float


def stuck_pixels(adu: np.ndarray, read_noise_adu: float, ratio: float) -> np.ndarray:
    """Find pixels that scatter over time far less than the read noise lets any pixel do.

    Parameters
    ----------
    adu : ndarray, (frames, rows, columns)
        Counts of valid frames.
    read_noise_adu : float
        Declared read noise [ADU]; the quietest fifth of the window is believed if it is quieter.
    ratio : float
        Scatter of a stuck pixel over the read noise, see `Thresholds.stuck_ratio`.

    Returns
    -------
    ndarray of bool, (rows, columns)
        All False with fewer than three frames, or if digitisation hides the noise.
    """
    if len(adu) < 3:
        return np.zeros(adu.shape[1:], dtype=bool)
    scatter = adu[sample_frames(len(adu))].std(axis=0, ddof=1, dtype=np.float64)
    floor = min(read_noise_adu, float(np.percentile(scatter, 20)))
    if floor <= (0.3 if adu.dtype.kind in "iu" else 0.0):
        return np.zeros(scatter.shape, dtype=bool)
    degrees = min(len(adu), SAMPLE_FRAMES) - 1
    by_chance = np.sqrt(chi2.ppf(FALSE_ALARM / scatter.size, degrees) / degrees)
    return scatter <= floor * min(ratio, by_chance)


def deviant_pixels(
    images_e: np.ndarray, good: np.ndarray, sampling_px: float, noise: NoiseModel, thresholds: Thresholds
) -> np.ndarray:
    """Find pixels that differ from what their neighbours predict, in the median over the frames.

    The worst pixels are taken out first and the rest judged again without them. The noise is at
    least what the frames show over time, and scaled up to the scatter over the window, so that an
    underestimated read noise or a pattern of rows makes no bad pixels.

    Parameters
    ----------
    images_e, good, sampling_px, noise
        See the module.
    thresholds : Thresholds
        `sigma` and `fraction` are used.

    Returns
    -------
    ndarray of bool, (rows, columns)
    """
    sample = images_e[sample_frames(len(images_e))]
    found = np.zeros(good.shape, dtype=bool)
    for _ in range(MAX_ROUNDS):
        deviation, limit = _deviation(sample, good & ~found, sampling_px, noise, thresholds)
        worst = _local_maxima(np.where(good & ~found & (deviation > limit), deviation, 0.0))
        if not worst.any():
            break
        found |= worst
    # a good pixel between two bad ones may have been blamed first
    return found & (deviation > limit)


def _deviation(
    sample: np.ndarray, good: np.ndarray, sampling_px: float, noise: NoiseModel, thresholds: Thresholds
) -> tuple[np.ndarray, np.ndarray]:
    """Absolute deviation from the neighbours, and what is tolerated [e-]."""
    prediction = neighbour_prediction(good, sampling_px)
    residual = sample - prediction.of(sample)
    deviation = np.abs(np.median(residual, axis=0))
    mean = sample.mean(axis=0, dtype=np.float64)
    # a hot pixel must not excuse itself by its own photon noise
    expected = prediction.variance(noise.variance_e2(np.minimum(mean, prediction.of(mean))))
    sigma = np.sqrt(np.maximum(expected, _seen_variance(residual)) * _variance_of_median(len(sample)))
    scale = max(1.0, 1.4826 * float(np.median((deviation / sigma)[good])))
    limit = np.maximum(thresholds.sigma * scale * sigma, thresholds.fraction * prediction.local_rms(mean))
    return deviation, limit


def _seen_variance(residual: np.ndarray) -> np.ndarray | float:
    """Variance over time that is usual around each pixel; 0 with too few frames."""
    if len(residual) < MIN_FRAMES_FOR_NOISE:
        return 0.0
    return median_filter(_inner_scatter(residual) ** 2, size=5, mode="nearest")


def _variance_of_median(frames: int) -> float:
    """Variance of the median of `frames` normal values, over the variance of one."""
    return 1 / frames if frames < 3 else np.pi / 2 / frames


def _local_maxima(values: np.ndarray) -> np.ndarray:
    """Positive values that no other value within reach of the prediction exceeds."""
    return (values > 0) & (values == maximum_filter(values, size=5, mode="constant"))


def noisy_pixels(
    images_e: np.ndarray, good: np.ndarray, sampling_px: float, noise: NoiseModel, thresholds: Thresholds
) -> np.ndarray:
    """Find pixels that scatter over time far more than their brightness and their surroundings explain.

    Parameters
    ----------
    images_e, good, sampling_px, noise
        See the module.
    thresholds : Thresholds
        `noisy_ratio`, `sigma` and `fraction` are used.

    Returns
    -------
    ndarray of bool, (rows, columns)
        All False with fewer than `MIN_FRAMES_FOR_NOISE` frames.
    """
    found = np.zeros(good.shape, dtype=bool)
    if len(images_e) < MIN_FRAMES_FOR_NOISE:
        return found
    sample = images_e[sample_frames(len(images_e))]
    for _ in range(MAX_ROUNDS):
        ratio = _noise_ratio(sample, neighbour_prediction(good & ~found, sampling_px), noise, thresholds)
        suspect = np.where(good & ~found, ratio, 0.0)
        worst = _local_maxima(np.where(suspect > thresholds.noisy_ratio, suspect, 0.0))
        if not worst.any():
            break
        found |= worst
    return found


def _noise_ratio(
    sample: np.ndarray, prediction: Prediction, noise: NoiseModel, thresholds: Thresholds
) -> np.ndarray:
    """Scatter over time of (pixel - prediction), over what noise and nearby pixels let expect."""
    mean = sample.mean(axis=0, dtype=np.float64)
    scatter = _inner_scatter(sample - prediction.of(sample))
    expected = np.sqrt(prediction.variance(noise.variance_e2(mean)))
    tolerated = np.hypot(expected, thresholds.fraction * prediction.local_rms(mean) / thresholds.sigma)
    ratio = scatter / tolerated
    return ratio / np.maximum(1.0, median_filter(ratio, size=9, mode="nearest"))


def _inner_scatter(values: np.ndarray) -> np.ndarray:
    """Standard deviation along the first axis from the inner 80 %, blind to single hits."""
    low = np.percentile(values, 10, axis=0, method="higher")
    high = np.percentile(values, 90, axis=0, method="lower")
    return (high - low) / 2.5631


def hot_in_dark(dark_adu: np.ndarray, detector: Detector, thresholds: Thresholds) -> np.ndarray:
    """Find pixels whose dark current stands out and whose shot noise no subtraction removes.

    Parameters
    ----------
    dark_adu : ndarray, (rows, columns)
        Finite [ADU].
    detector : Detector
        Gain and declared noise.
    thresholds : Thresholds
        `noisy_ratio` is used.

    Returns
    -------
    ndarray of bool, (rows, columns)
    """
    excess = dark_adu - median_filter(dark_adu, size=5, mode="nearest")
    pattern = 1.4826 * np.median(np.abs(excess))
    shot_noise_e2 = detector.excess_noise_factor * np.maximum(excess, 0) * detector.e_per_adu
    noisy = shot_noise_e2 > (thresholds.noisy_ratio * detector.read_noise_e) ** 2
    return noisy & (excess > HOT_OVER_PATTERN * pattern)


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


def _suspicious_frames(
    images_e: np.ndarray,
    frames: np.ndarray,
    good: np.ndarray,
    prediction: Prediction,
    noise: NoiseModel,
    thresholds: Thresholds,
) -> list[int]:
    """Frames in which any good pixel leaves its usual relation to its neighbours by more than the limit."""
    sample = images_e[frames[sample_frames(len(frames))]]
    usual = np.median(sample - prediction.of(sample), axis=0)
    mean = sample.mean(axis=0, dtype=np.float64)
    sigma = np.sqrt(prediction.variance(noise.variance_e2(mean)))
    limit = np.maximum(thresholds.sigma * sigma, thresholds.fraction * prediction.local_rms(mean))
    suspicious = []
    for block in blocks(len(frames)):
        searched = images_e[frames[block]]
        excess = np.abs(searched - prediction.of(searched) - usual) > limit
        suspicious.extend(frames[block][(excess & good).any(axis=(1, 2))].tolist())
    return suspicious


def flickering_pixels(hits: Hits, frames: int, window: tuple[int, int], fraction: float) -> np.ndarray:
    """Find pixels of the `window` that are hit too often to be unlucky, (rows, columns).

    Those are the pixels with `hits` in more than a `fraction` of so many `frames`, and in three at least.
    """
    return hits.per_pixel(window) > max(2, fraction * frames)


def without_bad_pixels(images_e: np.ndarray, good: np.ndarray, sampling_px: float) -> np.ndarray:
    """Return `images_e` with pixels that are not `good` predicted from their good neighbours.

    They are 0 where there are none; `sampling_px` is that of the module.
    """
    if good.all():
        return images_e
    rows = np.flatnonzero(~good.ravel())
    weights = neighbour_prediction(good, sampling_px).weights[rows]
    filled = images_e.reshape(len(images_e), good.size).copy()
    for block in blocks(len(filled)):
        images = filled[block]
        images[:, rows] = 0.0
        images[:, rows] = (weights @ images.T).T
    return filled.reshape(images_e.shape)


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
