"""Noise measured in the frames of the star itself: read noise, excess noise, and the noise of the dark.

The noise of a dark image that is taken from every frame is the same in all frames and does not average
out. A single dark image cannot distinguish it from the detector's own pattern, which is taken out with it
and does no harm; the mean of the frames can: what the dark left there varies from pixel to pixel, faster
than the image of any star, which ends at the cut-off of the telescope, D/λ.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from irlos_pipe.conventions.units import SIGMA_OF_MEDIAN
from irlos_pipe.frames.bad_pixels import Prediction
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import frame_variance, mean_frame, sample_frames

PREDICTION_ERROR = 0.01  # of the local brightness; a pixel where it dominates the noise is left out
DOMINATES = (0.1, 10.0)  # times the expected variance: of a single frame, and over time
MIN_PIXELS = 100  # pixels times frames that determine the noise, at least
FEWEST = 10  # pixels, at least, for two or three terms
PHOTON_ERROR = 0.02  # relative error of the photon noise that is subtracted from a single frame
ROUNDS = 5
SELECTIONS = 20  # rounds, at most, of choosing the pixels that count
SIGNIFICANT = 5.0  # standard errors
FAINTEST = 5.0  # percentile of the pixels at which noise beyond the declared one shows
FAINT = 0.25  # part of the window
CHI2_MEDIAN = 0.4549  # of one degree of freedom


@dataclass(frozen=True)
class MeasuredNoise:
    """Noise found in the frames, with 1-sigma errors; NaN where it could not be measured."""

    floor_e2: float = float("nan")  # variance per pixel and frame at zero signal above the background [e-²]
    floor_error_e2: float = float("nan")
    excess_noise_factor: float = float("nan")  # slope of variance against signal (1 = Poisson)
    excess_noise_error: float = float("nan")
    # RMS over time of the darkest pixels: what neighbours share, as stripes and a halo, included [e-]
    corner_scatter_e: float = float("nan")

    def beyond_e2(self, known_e2: float) -> float:
        """Return the part of the floor that `known_e2` leaves unexplained; 0 unless significant [e-²]."""
        extra = self.floor_e2 - known_e2
        return float(extra) if extra > SIGNIFICANT * self.floor_error_e2 else 0.0


def measure_noise(
    images_e: np.ndarray, good: np.ndarray, prediction: Prediction, declared: NoiseModel
) -> MeasuredNoise:
    """Fit variance = floor + F·signal + k²·brightness² to the scatter of (pixel - prediction).

    The difference of a pixel from the prediction by its neighbours is blind to speckles and image motion, so
    that the photon-transfer method works on sky; what is left of them, and of an unequal response, grows like
    the brightness and is the third term; where it is not significant, the fit does without it and without the
    pixels that it concerns most. The floor holds the read noise and the photon noise of dark current and sky.
    Of a single frame the difference itself takes the place of its scatter over time, where the star is so
    faint that its own structure does not count; that gives the floor only.

    The `images_e` (frames, rows, columns) are finite [e-], `good` pixels (rows, columns) True; `prediction`
    is that of each pixel by its good neighbours. Only a single frame is compared with the noise as
    `declared`: its star's photon noise is taken out.
    """
    if not len(images_e):
        return MeasuredNoise()
    sample = images_e[sample_frames(len(images_e))]
    if len(sample) == 1:
        return _floor_of_one(sample[0], good, prediction, declared)
    scatter = _Scatter.of(sample, prediction)
    floor, slope = _photon_transfer(scatter, good)
    return MeasuredNoise(*floor, *slope, _corner_scatter_e(sample, good))


@dataclass(frozen=True)
class _Scatter:
    """The variance over time of (pixel - prediction), and what it may consist of; (rows, columns) [e-²]."""

    variance: np.ndarray
    # what a floor of 1 e-², a slope of 1, and an unpredicted part of 1 of the brightness contribute
    flat: np.ndarray
    photons: np.ndarray
    structure: np.ndarray
    frames: int  # independent differences behind each variance
    dependence: float  # see `Prediction.dependence`

    @classmethod
    def of(cls, sample: np.ndarray, prediction: Prediction) -> "_Scatter":
        """Return the scatter of a `sample` (frames, rows, columns)."""
        signal = sample.mean(axis=0, dtype=np.float64)
        variance = (sample - prediction.of(sample)).var(axis=0, ddof=1, dtype=np.float64)
        return cls(variance, *_parts(signal, prediction), len(sample) - 1, prediction.dependence)

    def expected(self, floor: float, slope: float) -> np.ndarray:
        """Return the variance of that floor and slope, (rows, columns) [e-²]."""
        return slope * np.maximum(self.photons, 0) + floor * self.flat

    def fitted(self, chosen: np.ndarray, expected: np.ndarray, count: int) -> list[tuple[float, float]]:
        """Fit the first `count` terms to the `chosen` pixels; see `_fit`."""
        terms = np.stack([self.flat, self.photons, self.structure][:count], axis=-1)[chosen]
        degrees = self.frames / self.dependence
        return _fit(terms, np.zeros(1), self.variance[chosen], expected[chosen], degrees)


def _parts(signal: np.ndarray, prediction: Prediction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What floor, photons and structure contribute to the variance of (pixel - prediction)."""
    flat = prediction.variance(np.ones_like(signal))
    return flat, prediction.variance(signal), prediction.local_rms(signal) ** 2


def _photon_transfer(scatter: _Scatter, good: np.ndarray) -> list[tuple[float, float]]:
    """Floor and slope, each with its error; NaN where too few pixels determine them.

    Which pixels count, and for how much, depends on the noise that is sought. It begins with the least that
    can be, from the scatter itself and not from the declared noise: frames in other units then have the same
    noise in other units, and pixels that image motion rules are not taken for noise.
    """
    found = [(float("nan"), float("nan"))] * 2
    seen, slope = _least(scatter, good)
    floor, before = seen, None
    for _ in range(SELECTIONS):
        expected = scatter.expected(max(floor, seen), slope)
        faint, most = (
            good & (PREDICTION_ERROR**2 * scatter.structure < limit * expected) for limit in DOMINATES
        )
        if faint.sum() < FEWEST or faint.sum() * scatter.frames < MIN_PIXELS:
            if before is not None:
                break
            seen, floor, slope = 2 * seen, 2 * floor, 2 * slope
            continue
        if before is not None and all(map(np.array_equal, before, (faint, most))):
            break
        before = faint, most
        *found, (left, left_error) = scatter.fitted(most, expected, 3)
        if not left > SIGNIFICANT * left_error:
            found = scatter.fitted(faint, expected, 2)
        (floor, _), (slope, _) = found
    return found


def _least(scatter: _Scatter, good: np.ndarray) -> tuple[float, float]:
    """The least floor and slope that can be: of the quietest pixels, among all and among the brightest."""
    if not good.any():
        return 0.0, 0.0
    variance, light = scatter.variance[good], scatter.photons[good]
    lit = (light >= np.quantile(light, 1 - FAINT)) & (light > 0)
    slope = float(np.percentile(variance[lit] / light[lit], FAINTEST)) if lit.any() else 0.0
    return float(np.percentile(variance / scatter.flat[good], FAINTEST)), slope


def _floor_of_one(
    image: np.ndarray, good: np.ndarray, prediction: Prediction, declared: NoiseModel
) -> MeasuredNoise:
    """The floor of a single frame, without the declared photon noise."""
    # the pixel's own noise would weigh it
    flat, photons, structure = _parts(np.maximum(prediction.of(image), 0), prediction)
    variance = (image - prediction.of(image)) ** 2
    seen = float(np.percentile(variance[good] / flat[good], FAINTEST)) if good.any() else 0.0
    expected = declared.excess_noise_factor * photons + max(declared.floor_e2, seen) * flat
    faint = good & (PREDICTION_ERROR**2 * structure < DOMINATES[0] * expected)
    if faint.sum() < MIN_PIXELS:
        return MeasuredNoise()
    known, degrees = declared.excess_noise_factor * photons[faint], 1 / prediction.dependence
    ((floor, error),) = _fit(flat[faint, None], known, variance[faint], expected[faint], degrees)
    return MeasuredNoise(floor, float(np.hypot(error, PHOTON_ERROR * np.median(known / flat[faint]))))


def _corner_scatter_e(images_e: np.ndarray, good: np.ndarray) -> float:
    mean_e = np.where(good, images_e.mean(axis=0, dtype=np.float64), np.inf)
    darkest = mean_e <= np.percentile(mean_e[good], FAINTEST)
    return float(np.sqrt(np.median(images_e[:, darkest].var(axis=0, ddof=1, dtype=np.float64))))


def _fit(
    terms: np.ndarray, known: np.ndarray, variance: np.ndarray, expected: np.ndarray, degrees: float
) -> list[tuple[float, float]]:
    """Coefficients of ``variance = known + terms``, each with its error; the first is that of the floor.

    The weights follow the fitted variance, for a variance scatters in proportion to itself. No coefficient is
    negative, but the floor may be while it is fitted: a level of the background that is too low by some
    electrons takes as many off it, which would else be taken off the slope.
    """
    lowest = np.array([-np.inf, 0.0, 0.0])[: terms.shape[1]]
    for _ in range(ROUNDS):
        weighted = terms / expected[:, None]
        unit = np.linalg.norm(weighted, axis=0)  # the terms differ by powers of the unit of the frames
        unit[unit == 0] = 1.0
        solved = scipy.optimize.lsq_linear(
            weighted / unit, (variance - known) / expected, (lowest, np.inf), "bvls"
        )
        solution = solved.x / unit
        expected = np.maximum(known + terms @ solution, 0.05 * expected)
    present = solution > lowest
    inside = (weighted / unit)[:, present]
    errors = np.full(len(solution), np.nan)
    errors[present] = np.sqrt(np.diag(np.linalg.inv(inside.T @ inside)) * 2 / degrees) / unit[present]
    return list(zip(np.maximum(solution, 0.0).tolist(), errors.tolist(), strict=True))


def mean_variance(stack: np.ndarray) -> float:
    """Return the variance per pixel of the mean of a stack (frames, rows, columns) of dark images.

    From a single image it is judged by the differences of neighbouring pixels, an upper bound:
    a true pattern of the detector counts as noise.
    """
    if stack.shape[0] > 1:
        return float(np.median(frame_variance(stack, mean_frame(stack))) / stack.shape[0])
    differences = np.diff(stack[0].astype(np.float64), axis=1)
    scatter = SIGMA_OF_MEDIAN * np.median(np.abs(differences - np.median(differences)))
    return float(scatter**2 / 2)


def dark_variance_e2(
    images_e: np.ndarray, good: np.ndarray, prediction: Prediction | None, at_most_e2: float
) -> float:
    """Measure the variance per pixel of the dark image in the frames that it was taken from [e-²].

    That is the variance over the window of (pixel - prediction), in the mean of `images_e` (frames, rows,
    columns), beyond the scatter between frames. Only `good` pixels count at which the star's own detail, as
    far as the `prediction` leaves it open, is less than that scatter. The result is at most `at_most_e2`: as
    judged from the dark itself, the detector's pattern included, infinite if none was taken. Where the frames
    do not show it, as where there is no `prediction` because detail as fine as a pixel is the star's, it is
    `at_most_e2`, or 0 if that is infinite.
    """
    unknown_e2 = at_most_e2 if np.isfinite(at_most_e2) else 0.0
    if prediction is None or at_most_e2 == 0 or len(images_e) < 2:
        return unknown_e2
    mean_e = mean_frame(images_e)
    by_scatter = prediction.variance(frame_variance(images_e, mean_e) / len(images_e))
    detail = (np.maximum(prediction.error, PREDICTION_ERROR) * prediction.local_rms(mean_e)) ** 2
    seen = good & (detail < DOMINATES[0] * by_scatter)
    if seen.sum() < MIN_PIXELS:
        return unknown_e2
    left, scatter = (mean_e - prediction.of(mean_e))[seen] ** 2, by_scatter[seen]
    gain = prediction.variance(np.ones_like(mean_e))[seen]

    def beyond(dark_e2: float) -> float:
        return float(np.median(left / (scatter + dark_e2 * gain))) - CHI2_MEDIAN

    if beyond(0.0) <= 0:
        return 0.0
    most_e2 = min(at_most_e2, float(np.max(left / gain)) / CHI2_MEDIAN)
    return scipy.optimize.brentq(beyond, 0.0, most_e2) if beyond(most_e2) < 0 else most_e2
