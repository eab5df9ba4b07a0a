"""Read noise and excess noise measured on the star itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from irlos_pipe.frames.bad_pixels import sample_frames
from irlos_pipe.frames.detector import pixel_variance_e2
from irlos_pipe.frames.neighbour_prediction import Prediction
from irlos_pipe.frames.recording import Detector

PREDICTION_ERROR = 0.01  # of the local brightness; where it rivals the noise a pixel tells nothing
MIN_FRAMES = 10
MIN_PIXELS = 100
ROUNDS = 5
SIGNIFICANT = 5.0  # sigma


@dataclass(frozen=True)
class MeasuredNoise:
    """Noise found in the frames; NaN where it could not be measured.

    Attributes
    ----------
    floor_e2, floor_error_e2 : float
        Variance per pixel and frame at zero signal above the background, and its 1-sigma error [e-²].
    excess_noise_factor : float
        Slope of variance against signal (1 = Poisson).
    """

    floor_e2: float = float("nan")
    floor_error_e2: float = float("nan")
    excess_noise_factor: float = float("nan")

    def beyond_e2(self, known_e2: float) -> float:
        """Part of the floor that `known_e2` leaves unexplained; 0 unless it is significant [e-²]."""
        extra = self.floor_e2 - known_e2
        return float(extra) if extra > SIGNIFICANT * self.floor_error_e2 else 0.0


def measure_noise(
    images_e: np.ndarray, good: np.ndarray, prediction: Prediction, detector: Detector
) -> MeasuredNoise:
    """Fit variance = floor + F·signal to the scatter of (pixel - prediction by its neighbours).

    That difference is blind to speckles and image motion, so that the photon-transfer method
    works on sky. The floor holds the read noise and the photon noise of dark current and sky.

    Parameters
    ----------
    images_e : ndarray, (frames, rows, columns)
        Finite [e-].
    detector : Detector
        Its declared noise is where the weights start from.
    """
    if len(images_e) < MIN_FRAMES:
        return MeasuredNoise()
    sample = images_e[sample_frames(len(images_e))]
    signal = np.maximum(sample.mean(axis=0, dtype=np.float64), 0)
    expected = prediction.variance(pixel_variance_e2(signal, detector))
    usable = good & ((PREDICTION_ERROR * prediction.local_rms(signal)) ** 2 < 0.1 * expected)
    if usable.sum() < MIN_PIXELS:
        return MeasuredNoise()
    variance = (sample - prediction.of(sample)).var(axis=0, ddof=1)
    terms = np.stack([prediction.variance(np.ones_like(signal)), prediction.variance(signal)], axis=-1)
    return _fit(terms[usable], variance[usable], expected[usable], len(sample) - 1)


def _fit(terms: np.ndarray, variance: np.ndarray, expected: np.ndarray, degrees: int) -> MeasuredNoise:
    """Linear fit whose weights follow the fitted variance: a variance scatters in proportion to itself."""
    for _ in range(ROUNDS):
        weighted = terms / expected[:, None]
        (floor, slope), *_ = np.linalg.lstsq(weighted, variance / expected, rcond=None)
        expected = np.maximum(terms @ (floor, slope), 0.05 * expected)
    covariance = np.linalg.inv(weighted.T @ weighted) * 2 / degrees
    return MeasuredNoise(float(floor), float(np.sqrt(covariance[0, 0])), float(slope))
