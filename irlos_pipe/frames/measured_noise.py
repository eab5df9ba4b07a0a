"""Noise measured in the frames of the star itself: read noise, excess noise, and the noise of the dark.

The noise of a dark image that is taken from every frame is the same in all frames and does not average
out. A single dark image cannot distinguish it from the detector's own pattern, which is taken out with it
and does no harm; the mean of the frames can: what the dark left there varies from pixel to pixel, faster
than the image of any star, which ends at the cut-off of the telescope, D/λ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from irlos_pipe.frames.blocks import frame_variance, mean_frame, sample_frames
from irlos_pipe.frames.neighbour_prediction import Prediction
from irlos_pipe.frames.noise import NoiseModel

PREDICTION_ERROR = 0.01  # of the local brightness; a pixel where it dominates the noise is left out
DOMINATES = (0.1, 10.0)  # times the variance expected: of a single frame, and over time
MIN_PIXELS = 100
PHOTON_ERROR = 0.02  # of the photon noise that a single frame is relieved of before its floor is measured
ROUNDS = 5
SIGNIFICANT = 5.0  # sigma
FINE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # along both axes: leaves what is finer than 3 pixels
FAINTEST = 5.0  # percent of the pixels, where a noise beyond the declared one shows
FAINT = 0.25  # part of the window, the faintest, where the star's own structure is least
CHI2_MEDIAN = 0.4549  # of one degree of freedom


@dataclass(frozen=True)
class MeasuredNoise:
    """Noise found in the frames; NaN where it could not be measured.

    Attributes
    ----------
    floor_e2, floor_error_e2 : float
        Variance per pixel and frame at zero signal above the background, and its 1-sigma error [e-²].
    excess_noise_factor, excess_noise_error : float
        Slope of variance against signal (1 = Poisson), and its 1-sigma error.
    corner_scatter_e : float
        RMS over time of the darkest pixels: what neighbours share, as stripes and a halo, included [e-].
    """

    floor_e2: float = float("nan")
    floor_error_e2: float = float("nan")
    excess_noise_factor: float = float("nan")
    excess_noise_error: float = float("nan")
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
    the brightness and is the third term; where it is not significant, the fit does without it and without
    the pixels that it concerns most. The floor holds the read noise and the photon noise of dark current
    and sky. Of a single frame the difference itself takes the place of its scatter over time, where the star
    is so faint that its own structure does not count; that tells the floor only.

    Parameters
    ----------
    images_e : ndarray, (frames, rows, columns)
        Finite [e-].
    good : ndarray of bool, (rows, columns)
        True for good pixels.
    prediction : Prediction
        Of each pixel by its good neighbours.
    declared : NoiseModel
        Where the weights start from.
    """
    if not len(images_e):
        return MeasuredNoise()
    sample = images_e[sample_frames(len(images_e))]
    single = len(sample) == 1
    signal = sample.mean(axis=0, dtype=np.float64)
    residual = sample - prediction.of(sample)
    variance = residual[0] ** 2 if single else residual.var(axis=0, ddof=1)
    if single:
        signal = np.maximum(prediction.of(signal), 0)  # the pixel's own noise would weigh it
    flat = prediction.variance(np.ones_like(signal))
    photons, structure = prediction.variance(signal), prediction.local_rms(signal) ** 2
    seen = float(np.percentile(variance[good] / flat[good], FAINTEST)) if good.any() else 0.0
    expected = declared.excess_noise_factor * np.maximum(photons, 0) + max(declared.floor_e2, seen) * flat
    terms = np.stack([flat, photons, structure], axis=-1)
    faint, most = (good & (PREDICTION_ERROR**2 * structure < limit * expected) for limit in DOMINATES)
    degrees = max(len(sample) - 1, 1) / prediction.dependence
    if faint.sum() * max(len(sample) - 1, 1) < MIN_PIXELS:
        return MeasuredNoise()
    if single:
        known = declared.excess_noise_factor * photons[faint]
        ((floor, error),) = _fit(terms[faint, :1], known, variance[faint], expected[faint], degrees)
        return MeasuredNoise(floor, float(np.hypot(error, PHOTON_ERROR * np.median(known / flat[faint]))))
    none = np.zeros(1)
    *found, (left, left_error) = _fit(terms[most], none, variance[most], expected[most], degrees)
    if not left > SIGNIFICANT * left_error:
        found = _fit(terms[faint, :2], none, variance[faint], expected[faint], degrees)
    return MeasuredNoise(*found[0], *found[1], _corner_scatter_e(sample, good))


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
        solved = scipy.optimize.lsq_linear(weighted, (variance - known) / expected, (lowest, np.inf), "bvls")
        solution = solved.x
        expected = np.maximum(known + terms @ solution, 0.05 * expected)
    present = solution > lowest
    inside = weighted[:, present]
    errors = np.full(len(solution), np.nan)
    errors[present] = np.sqrt(np.diag(np.linalg.inv(inside.T @ inside)) * 2 / degrees)
    return list(zip(np.maximum(solution, 0.0).tolist(), errors.tolist(), strict=True))


def mean_variance(stack: np.ndarray) -> float:
    """Return the variance per pixel of the mean of a stack (frames, rows, columns) of dark images.

    From a single image it is judged by the differences of neighbouring pixels, an upper bound:
    a true pattern of the detector counts as noise.
    """
    if stack.shape[0] > 1:
        return float(np.median(frame_variance(stack, mean_frame(stack))) / stack.shape[0])
    differences = np.diff(stack[0].astype(np.float64), axis=1)
    scatter = 1.4826 * np.median(np.abs(differences - np.median(differences)))
    return float(scatter**2 / 2)


def dark_variance_e2(images_e: np.ndarray, good: np.ndarray, at_most_e2: float) -> float:
    """Measure the variance per pixel of the dark image in the frames that it was taken from.

    Parameters
    ----------
    images_e : ndarray, (frames, rows, columns)
        Signal above the dark [e-].
    good : ndarray of bool, (rows, columns)
        True for good pixels.
    at_most_e2 : float
        Variance of the dark as judged from the dark itself, the detector's pattern included [e-²]; infinite
        if none was taken.

    Returns
    -------
    float
        Variance of the mean frame from pixel to pixel beyond the scatter between frames [e-²]; a star that
        is sharper than the pixels can show raises it, up to `at_most_e2`. Where frames do not show it,
        `at_most_e2`, or 0 if that is infinite.
    """
    unknown_e2 = at_most_e2 if np.isfinite(at_most_e2) else 0.0
    if at_most_e2 == 0 or len(images_e) < 2 or min(good.shape) < 2 * len(FINE):
        return unknown_e2
    mean_e = mean_frame(images_e)
    scatter_e2 = frame_variance(images_e, mean_e) / len(images_e)
    mean_e = np.where(good, mean_e, np.nan)
    fine, by_scatter = _both_ways(mean_e, FINE) ** 2, _both_ways(scatter_e2, FINE**2)
    seen = np.isfinite(fine) & (mean_e <= np.nanquantile(mean_e, FAINT))
    if not seen.any():
        return unknown_e2
    beyond = np.median(fine[seen]) / CHI2_MEDIAN - np.median(by_scatter[seen])
    return float(np.clip(beyond / np.sum(FINE**2) ** 2, 0.0, at_most_e2))


def _both_ways(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Convolution along rows and columns; NaN near edges and bad pixels."""
    for axis in (0, 1):
        image = scipy.ndimage.convolve1d(image, kernel, axis=axis, mode="constant", cval=np.nan)
    return image
