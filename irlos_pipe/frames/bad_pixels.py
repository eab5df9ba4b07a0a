"""Bad pixels, recognised by what they do over time and between neighbours.

A pixel is predicted from its neighbours: an image formed by a telescope has no detail finer than lambda/D.
Whatever a well-sampled image shows beyond the prediction is noise or the detector's fault. The test
therefore holds in the core of a bright star as well as in its wings, whatever the wavefront.

Throughout, `images_e` are finite images (frames, rows, columns) [e-], `good` (rows, columns) is True for
pixels not known to be bad, and `by` are the `Criteria` by which pixels are judged.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from irlos_pipe.conventions.units import SIGMA_OF_MEDIAN
from irlos_pipe.frames.noise import MIN_FRAMES_FOR_NOISE, NoiseModel
from irlos_pipe.frames.recording import SAMPLE_FRAMES, Detector, blocks, sample_frames

REACH_PX = 3  # neighbours are the other pixels of a (2 * REACH_PX + 1) square
NEAR_PX = 2  # neighbours whose brightness says how bright a pixel could be
NUGGET = 1e-4  # variance over signal squared that the weights allow for: noise, 1 % of unequal response
CUTOFF_MARGIN = 1.1  # room for an error of the pixel scale
MIN_SAMPLING_PX = 2.4  # pixels per lambda/D below which neighbours no longer determine a pixel


@dataclass(frozen=True)
class Prediction:
    """Linear prediction of every pixel of a window from its good neighbours."""

    weights: scipy.sparse.csr_matrix  # (pixels, pixels): row p gives pixel p; columns of bad pixels are 0
    average: scipy.sparse.csr_matrix  # (pixels, pixels): plain mean of the neighbours within `NEAR_PX`
    # (rows, columns): RMS of (pixel - prediction) without noise, over that of the image: detail that the
    # neighbours leave open. It grows where some of them are missing.
    error: np.ndarray
    # (2 * REACH_PX + 1, 2 * REACH_PX + 1): (pixel - prediction) of a pixel with all its neighbours
    kernel: np.ndarray

    @property
    def dependence(self) -> float:
        """Pixels that count as one in a mean of (pixel - prediction)², for they share neighbours."""
        padded = [2 * side for side in self.kernel.shape]  # against wrapping round
        power = np.abs(np.fft.fft2(self.kernel, padded)) ** 2 / np.sum(self.kernel**2)
        return float(np.mean(power**2))  # Parseval: the sum of the squared autocorrelation

    def of(self, images: np.ndarray) -> np.ndarray:
        """Return the predicted images, (..., rows, columns) like `images`."""
        return _apply(self.weights, images)

    def variance(self, pixel_variance: np.ndarray) -> np.ndarray:
        """Return the variance of (pixel - prediction), from `pixel_variance` of independent pixels."""
        squares = scipy.sparse.csr_matrix(
            (self.weights.data**2, self.weights.indices, self.weights.indptr), self.weights.shape
        )
        return pixel_variance + _apply(squares, pixel_variance)

    def local_rms(self, image: np.ndarray) -> np.ndarray:
        """Return the root mean square of the neighbours of every pixel."""
        return np.sqrt(_apply(self.average, image.astype(np.float64) ** 2))


def neighbour_prediction(good: np.ndarray, sampling_px: float) -> Prediction:
    """Return the best linear prediction of each pixel from the `good` pixels (rows, columns) around it.

    The weights solve ``(C + nugget) w = c`` (simple kriging). The covariance of two pixels at distance r is
    the diffraction pattern ``[2 J1(z)/z]^2``, ``z = pi r / sampling``: its spectrum is the telescope's
    transfer function, which ends at D/lambda. `sampling_px` are pixels per lambda/D at the shortest
    wavelength.
    """
    offsets = _neighbour_offsets()
    inside, index = _neighbours(good.shape)
    available = inside & good.ravel()[index]
    # most pixels have all their neighbours; each pattern of those that are missing is solved once
    code = available @ (1 << np.arange(len(offsets), dtype=np.int64))
    _, first, which = np.unique(code, return_index=True, return_inverse=True)
    solved = [_kriging_weights(tuple(available[pixel].tolist()), sampling_px) for pixel in first]
    weights = np.stack([pattern for pattern, _ in solved])[which]
    error = np.array([left for _, left in solved])[which].reshape(good.shape)
    near = available & (np.abs(offsets).max(axis=1) <= NEAR_PX)
    counts = np.maximum(near.sum(axis=1, keepdims=True), 1)
    return Prediction(_sparse(weights, index), _sparse(near / counts, index), error, _kernel(sampling_px))


def _neighbour_offsets() -> np.ndarray:
    reach = range(-REACH_PX, REACH_PX + 1)
    return np.array([(dy, dx) for dy in reach for dx in reach if (dy, dx) != (0, 0)])


@lru_cache(maxsize=16)
def _neighbours(window: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Whether each neighbour of each pixel of a window exists, and its flat index; (pixels, neighbours)."""
    rows, columns = window
    offsets = _neighbour_offsets()
    y = np.arange(rows)[:, None, None] + offsets[:, 0]
    x = np.arange(columns)[None, :, None] + offsets[:, 1]
    y, x = np.broadcast_arrays(y, x)
    inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns)
    index = np.clip(y, 0, rows - 1) * columns + np.clip(x, 0, columns - 1)
    shape = (rows * columns, len(offsets))
    return inside.reshape(shape), index.astype(np.int32).reshape(shape)


@lru_cache(maxsize=10_000)
def _kriging_weights(available: tuple[bool, ...], sampling_px: float) -> tuple[np.ndarray, float]:
    """Weights of the neighbours, 0 for those not available, and the error; patterns recur between frames."""
    weights, mask = np.zeros(len(available)), np.array(available)
    used = _neighbour_offsets()[mask]
    if not len(used):
        return weights, 1.0
    separation = np.hypot(*(used[:, None] - used[None]).transpose(2, 0, 1))
    between = _covariance(separation, sampling_px)
    towards = _covariance(np.hypot(*used.T), sampling_px)
    own = np.linalg.solve(between + NUGGET * np.eye(len(used)), towards)
    weights[mask] = own
    return weights, float(np.sqrt(max(0.0, 1 - 2 * own @ towards + own @ between @ own)))


def _kernel(sampling_px: float) -> np.ndarray:
    weights, _ = _kriging_weights((True,) * len(_neighbour_offsets()), sampling_px)
    side = 2 * REACH_PX + 1
    return np.insert(-weights, len(weights) // 2, 1.0).reshape(side, side)


def _covariance(distance_px: np.ndarray, sampling_px: float) -> np.ndarray:
    z = np.maximum(np.pi * distance_px * CUTOFF_MARGIN / sampling_px, 1e-6)
    return (2 * scipy.special.j1(z) / z) ** 2


def _sparse(values: np.ndarray, index: np.ndarray) -> scipy.sparse.csr_matrix:
    pixels, neighbours = values.shape
    starts = np.arange(0, pixels * neighbours + 1, neighbours, dtype=np.int32)
    return scipy.sparse.csr_matrix((values.ravel(), index.ravel(), starts), shape=(pixels, pixels))


def _apply(matrix: scipy.sparse.csr_matrix, images: np.ndarray) -> np.ndarray:
    flat = images.reshape(-1, matrix.shape[1])
    return (matrix @ flat.T).T.reshape(images.shape)


FALSE_ALARM = 1e-4  # chance that statistics alone make one good pixel of the window look stuck
HOT_OVER_PATTERN = 20.0  # sigma of the dark's own pattern, which may be a bias without shot noise
UNUSUAL = 4.0  # sigma of the deviations around, as parts of the brightness
MAX_ROUNDS = 60


@dataclass(frozen=True)
class Thresholds:
    """Limits beyond which a pixel counts as bad, by their keys in a recipe."""

    # deviation from the neighbours over the noise, and over their own brightness; both must be exceeded
    bad_pixel_sigma: float
    bad_pixel_fraction: float
    stuck_ratio: float  # scatter over time of a stuck pixel over the read noise
    noisy_ratio: float  # scatter of a noisy pixel over the scatter expected
    flicker_fraction: float  # of the frames, in which a pixel may be hit before it counts as bad


@dataclass(frozen=True)
class Criteria:
    """By what the pixels of a recording are judged."""

    sampling_px: float  # pixels per λ/D at the shortest wavelength
    noise: NoiseModel  # declared, of photons and read-out
    thresholds: Thresholds

    @property
    def well_sampled(self) -> bool:
        """Whether neighbours determine a pixel: a star of undersampled images is as sharp as a bad one."""
        return self.sampling_px >= MIN_SAMPLING_PX

    def prediction(self, good: np.ndarray) -> Prediction:
        """Return the prediction of each pixel by the `good` ones around it."""
        return neighbour_prediction(good, max(self.sampling_px, MIN_SAMPLING_PX))

    def filled(self, images_e: np.ndarray, good: np.ndarray) -> np.ndarray:
        """Return `images_e` with pixels that are not `good` predicted from those that are; 0 without any."""
        if good.all():
            return images_e
        rows = np.flatnonzero(~good.ravel())
        weights = self.prediction(good).weights[rows]
        filled = images_e.reshape(len(images_e), good.size).copy()
        for block in blocks(len(filled)):
            images = filled[block]
            images[:, rows] = 0.0
            images[:, rows] = (weights @ images.T).T
        return filled.reshape(images_e.shape)


def stuck_pixels(adu: np.ndarray, read_noise_adu: float, ratio: float) -> np.ndarray:
    """Find pixels that scatter over time far less than the read noise lets any pixel do.

    The `adu` (frames, rows, columns) are counts of valid frames; of the declared `read_noise_adu` and that of
    the quietest fifth of the window the lower one is believed; `ratio`: see `Thresholds.stuck_ratio`. Returns
    (rows, columns), all False with fewer than three frames, or if digitisation hides the noise.
    """
    if len(adu) < 3:
        return np.zeros(adu.shape[1:], dtype=bool)
    scatter = adu[sample_frames(len(adu))].std(axis=0, ddof=1, dtype=np.float64)
    floor = min(read_noise_adu, float(np.percentile(scatter, 20)))
    if floor <= (0.3 if adu.dtype.kind in "iu" else 0.0):
        return np.zeros(scatter.shape, dtype=bool)
    degrees = min(len(adu), SAMPLE_FRAMES) - 1
    # the quantile of χ²; `scipy.stats` would take a second to load
    by_chance = np.sqrt(2 * scipy.special.gammaincinv(degrees / 2, FALSE_ALARM / scatter.size) / degrees)
    return scatter <= floor * min(ratio, by_chance)


def deviant_pixels(images_e: np.ndarray, good: np.ndarray, by: Criteria) -> np.ndarray:
    """Find pixels that differ from what their neighbours predict, in the median over the frames.

    The noise is at least what the frames show over time, and scaled up to the scatter over the window, so
    that an underestimated read noise or a pattern of rows makes no bad pixels. The arguments `images_e`,
    `good` and `by` are those of the module; returns (rows, columns).
    """
    sample = images_e[sample_frames(len(images_e))]
    return _worst_first(lambda left: _deviation(sample, left, by), good)


def noisy_pixels(images_e: np.ndarray, good: np.ndarray, by: Criteria) -> np.ndarray:
    """Find pixels that scatter over time far more than their brightness and their surroundings explain.

    The arguments `images_e`, `good` and `by` are those of the module. Returns (rows, columns), all False with
    fewer than `MIN_FRAMES_FOR_NOISE` frames.
    """
    if len(images_e) < MIN_FRAMES_FOR_NOISE:
        return np.zeros(good.shape, dtype=bool)
    sample = images_e[sample_frames(len(images_e))]
    limit = by.thresholds.noisy_ratio
    return _worst_first(lambda left: (_noise_ratio(sample, by.prediction(left), by), limit), good)


def _worst_first(
    judge: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray | float]], good: np.ndarray
) -> np.ndarray:
    """Pixels beyond their limit; the worst are taken out first and the rest judged again without them."""
    found = np.zeros(good.shape, dtype=bool)
    for _ in range(MAX_ROUNDS):
        value, limit = judge(good & ~found)
        beyond = np.where(good & ~found & (value > limit), value, 0.0)
        # within reach of the prediction no other one is worse
        worst = (beyond > 0) & (beyond == scipy.ndimage.maximum_filter(beyond, size=5, mode="constant"))
        if not worst.any():
            break
        found |= worst
    # a good pixel between or beside bad ones may have been found deviant first
    return found & (value > limit)


def _deviation(sample: np.ndarray, good: np.ndarray, by: Criteria) -> tuple[np.ndarray, np.ndarray]:
    """Absolute deviation from the neighbours, and what is tolerated [e-]."""
    prediction, thresholds = by.prediction(good), by.thresholds
    residual = sample - prediction.of(sample)
    deviation = np.abs(np.median(residual, axis=0))
    mean = sample.mean(axis=0, dtype=np.float64)
    # a hot pixel must not excuse itself by its own photon noise
    expected = prediction.variance(by.noise.variance_e2(np.minimum(mean, prediction.of(mean))))
    of_median = 1 if len(sample) < 3 else np.pi / 2  # variance over that of the mean, of normal values
    sigma = np.sqrt(np.maximum(expected, seen_variance(residual)) * (of_median / len(sample)))
    scale = max(1.0, SIGMA_OF_MEDIAN * float(np.median((deviation / sigma)[good])))
    tolerated = np.maximum(
        optical_limit(prediction, mean, thresholds), _usual(deviation, prediction, mean, good)
    )
    return deviation, np.maximum(thresholds.bad_pixel_sigma * scale * sigma, tolerated)


def optical_limit(prediction: Prediction, mean: np.ndarray, thresholds: Thresholds) -> np.ndarray:
    """Return the deviation that optics and unequal response make of the brightness of a pixel [e-].

    The `prediction` is that by its good neighbours, `mean` the mean image (rows, columns) [e-]; of the
    `thresholds` those over brightness and noise are used.
    """
    around = np.sqrt(scipy.ndimage.uniform_filter(np.square(mean), size=2 * REACH_PX + 1, mode="nearest"))
    by_optics = thresholds.bad_pixel_sigma * prediction.error * around
    return np.hypot(thresholds.bad_pixel_fraction * _brightness(prediction, mean), by_optics)


def _brightness(prediction: Prediction, mean: np.ndarray) -> np.ndarray:
    """Brightness of a pixel as its neighbours have it, or theirs if that is more [e-]."""
    return np.maximum(np.maximum(prediction.local_rms(mean), prediction.of(mean)), 1e-9)


def _usual(deviation: np.ndarray, prediction: Prediction, mean: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Deviation that is not unusual for the brightness, judged by the pixels around [e-].

    A detector near its full well, or with an unequal response, is no sharper a spot than a speckle is.
    """
    brightness = _brightness(prediction, mean)
    relative = np.where(good, deviation / brightness, 0.0)
    return (
        UNUSUAL * SIGMA_OF_MEDIAN * scipy.ndimage.median_filter(relative, size=7, mode="nearest") * brightness
    )


def seen_variance(residual: np.ndarray) -> np.ndarray | float:
    """Return the variance over time that is usual around each pixel of `residual`; 0 with too few frames."""
    if len(residual) < MIN_FRAMES_FOR_NOISE:
        return 0.0
    return scipy.ndimage.median_filter(_inner_scatter(residual) ** 2, size=5, mode="nearest")


def _noise_ratio(sample: np.ndarray, prediction: Prediction, by: Criteria) -> np.ndarray:
    """Scatter over time of (pixel - prediction), over what noise and nearby pixels let expect."""
    mean = sample.mean(axis=0, dtype=np.float64)
    scatter = _inner_scatter(sample - prediction.of(sample))
    expected = np.sqrt(prediction.variance(by.noise.variance_e2(mean)))
    by_optics = optical_limit(prediction, mean, by.thresholds) / by.thresholds.bad_pixel_sigma
    tolerated = np.hypot(expected, by_optics)
    ratio = scatter / tolerated
    return ratio / np.maximum(1.0, scipy.ndimage.median_filter(ratio, size=9, mode="nearest"))


def _inner_scatter(values: np.ndarray) -> np.ndarray:
    """Standard deviation along the first axis from the inner 80 %, blind to single hits."""
    low, high = math.ceil(0.1 * (len(values) - 1)), math.floor(0.9 * (len(values) - 1))
    ordered = np.partition(values, (low, high), axis=0)
    return (ordered[high] - ordered[low]) / 2.5631


def hot_in_dark(dark_adu: np.ndarray, detector: Detector, thresholds: Thresholds) -> np.ndarray:
    """Find pixels whose dark current stands out and whose shot noise no subtraction removes.

    The `dark_adu` (rows, columns) is finite [ADU], `detector` has gain and declared noise, and of the
    `thresholds` that of noisy pixels is used.
    """
    excess = dark_adu - scipy.ndimage.median_filter(dark_adu, size=5, mode="nearest")
    pattern = SIGMA_OF_MEDIAN * np.median(np.abs(excess))
    shot_noise_e2 = detector.excess_noise_factor * np.maximum(excess, 0) * detector.e_per_adu
    noisy = shot_noise_e2 > (thresholds.noisy_ratio * detector.read_noise_e) ** 2
    return noisy & (excess > HOT_OVER_PATTERN * pattern)
