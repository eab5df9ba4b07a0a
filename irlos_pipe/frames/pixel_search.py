"""The search for clipped, bad and hit pixels of one recording, one kind after the other."""

from __future__ import annotations

import numpy as np

from irlos_pipe.frames.bad_pixels import (
    Thresholds,
    deviant_pixels,
    noisy_pixels,
    seen_variance,
    without_bad_pixels,
)
from irlos_pipe.frames.blocks import picked, sample_frames
from irlos_pipe.frames.clipping import clipped_samples
from irlos_pipe.frames.hits import NO_HITS, Hits, cosmic_hits, flickering_pixels, odd_frames, without_hits
from irlos_pipe.frames.measured_noise import MeasuredNoise, measure_noise
from irlos_pipe.frames.neighbour_prediction import MIN_SAMPLING_PX, is_well_sampled, neighbour_prediction
from irlos_pipe.frames.noise import MIN_FRAMES_FOR_NOISE, NoiseModel
from irlos_pipe.frames.recording import Detector

LEAST_FRAMES = 3  # whose median a single one does not move


class PixelSearch:
    """The search for what spoils single pixels, with its settings.

    Parameters
    ----------
    sampling_px : float
        Pixels per λ/D at the shortest wavelength. Undersampled images (2x2 modes) are not searched.
    detector : Detector
        Declared noise.
    thresholds : Thresholds
        Limits beyond which a pixel counts as bad.
    """

    def __init__(self, sampling_px: float, detector: Detector, thresholds: Thresholds) -> None:
        self._well_sampled = is_well_sampled(sampling_px)
        self._sampling_px = max(sampling_px, MIN_SAMPLING_PX)
        self._noise, self._thresholds = NoiseModel.of_detector(detector), thresholds

    def bad_pixels(
        self, images: np.ndarray, good: np.ndarray, reasons: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the mask of good pixels and the images with the others filled in.

        The `images` (frames, rows, columns) [e-] count where they have no `reasons` against them, `good` is
        what is known of the pixels so far.
        """
        sample = self._filled(used_sample(images, reasons), good)
        if self._well_sampled and len(sample):
            good = good & ~deviant_pixels(sample, good, *self._settings)
            good = good & ~noisy_pixels(sample, good, *self._settings)
        return good, self._filled(images, good)

    def clipped(
        self, images: np.ndarray, good: np.ndarray, reasons: np.ndarray, step_e: float
    ) -> tuple[np.ndarray, np.ndarray, Hits]:
        """Return mask and images without clipped values, and these; pixels clipped often are bad.

        The `images`, `good` and `reasons` are those of `bad_pixels`, `step_e` is the step of the digitisation
        [e-], 0 if there is none.
        """
        used = np.flatnonzero(reasons == "")
        if not self._well_sampled or len(used) < MIN_FRAMES_FOR_NOISE:
            return good, images, NO_HITS
        sample = used_sample(images, reasons)
        prediction = neighbour_prediction(good, self._sampling_px)
        mean = sample.mean(axis=0, dtype=np.float64)
        # what the frames show counts as well: the gain may be declared wrong
        seen = seen_variance(sample - prediction.of(sample)) / prediction.variance(np.ones_like(mean))
        sigma = np.sqrt(np.minimum(self._noise.variance_e2(mean), seen))
        frame, row, column = np.nonzero(clipped_samples(picked(images, reasons == ""), good, sigma, step_e))
        return self._without(images, good, Hits(used[frame], row, column), len(used))

    def hits(
        self, images: np.ndarray, good: np.ndarray, reasons: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, Hits]:
        """Return mask, images without hits, and the hits; pixels hit again and again are bad.

        The `images`, `good` and `reasons` are those of `bad_pixels`.
        """
        used = np.flatnonzero(reasons == "")
        if not self._well_sampled or len(used) < 2:
            return good, images, NO_HITS
        return self._without(images, good, cosmic_hits(images, used, good, *self._settings), len(used))

    def odd(self, images: np.ndarray, good: np.ndarray, core: np.ndarray, reasons: np.ndarray) -> np.ndarray:
        """Return which frames have detail outside the `core` that no light makes, (frames,).

        The `core` is that of the star, (rows, columns), other arguments are those of `hits`.
        """
        odd, used = np.zeros(len(images), dtype=bool), np.flatnonzero(reasons == "")
        if self._well_sampled and len(used) >= LEAST_FRAMES:
            odd[used] = odd_frames(images, used, good, core, *self._settings)
        return odd

    def noise(self, images: np.ndarray, good: np.ndarray, reasons: np.ndarray) -> MeasuredNoise:
        """Measure the noise; `images`, `good` and `reasons` are those of `bad_pixels`."""
        if not self._well_sampled:
            return MeasuredNoise()
        prediction = neighbour_prediction(good, self._sampling_px)
        return measure_noise(used_sample(images, reasons), good, prediction, self._noise)

    def _without(
        self, images: np.ndarray, good: np.ndarray, hits: Hits, frames: int
    ) -> tuple[np.ndarray, np.ndarray, Hits]:
        """Return mask, images and hits after pixels hit too often are bad and other hits are filled in."""
        flicker = flickering_pixels(hits, frames, good.shape, self._thresholds.flicker_fraction)
        hits = hits.outside(flicker)
        good = good & ~flicker
        images = self._filled(images, good) if flicker.any() else images
        return good, without_hits(images, hits, good, self._sampling_px), hits

    @property
    def _settings(self) -> tuple[float, NoiseModel, Thresholds]:
        return self._sampling_px, self._noise, self._thresholds

    def _filled(self, images: np.ndarray, good: np.ndarray) -> np.ndarray:
        return without_bad_pixels(images, good, self._sampling_px)


def used_sample(images: np.ndarray, reasons: np.ndarray) -> np.ndarray:
    """Return those of the `images` without `reasons` against them that suffice for statistics over time."""
    used = np.flatnonzero(reasons == "")
    return images[used[sample_frames(len(used))]]
