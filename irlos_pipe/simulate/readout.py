"""Raw frames in ADU, and the electrons that a calibration makes of them.

`irlos_pipe.simulate.detector` argues the order of what happens between photon and converter.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from irlos_pipe.simulate.detector import (
    ADC_TOP_ADU,
    FLAT_ERROR_STREAM,
    Pixels,
    flat_map,
    marked,
    multiplied,
    pedestal_map_adu,
    scattered,
)
from irlos_pipe.simulate.scene import Scene

DARK_FRAMES = 64  # raw frames that are averaged to the dark image
FLAT_ERROR = 1e-4  # relative RMS noise of the measured flat


def pixels_of(scene: Scene, mean_image_e: np.ndarray) -> Pixels:
    """Return the pixels of a `scene` with its effects.

    At the peak of its mean image `mean_image_e`, (rows, columns) [e-], a non-linearity is stated.
    """
    detector, window = scene.detector, scene.window
    read_s = scene.exposure_s / scene.reads
    dark_e = np.full(window, detector.dark_e_per_s * read_s)
    for pixel, e_per_s in detector.hot_e_per_s:
        dark_e[tuple(pixel)] += e_per_s * read_s
    pixels = Pixels(
        detector,
        flat_map(detector, window) * scattered(detector.flat_error_rms, detector, window, FLAT_ERROR_STREAM),
        dark_e,
        detector.crosstalk_fraction,
        detector.nonlinearity_per_e,
        hot_e=np.zeros(window),
        background_e=np.zeros(window),
        alive=np.ones(window),
        stuck_e=np.full(window, np.nan),
        reads=scene.reads,
        sky_e=scene.sky_e_per_s * read_s,
    )
    for effect in scene.acting("on"):
        pixels = effect.on(pixels, mean_image_e / pixels.reads)
    return pixels


def electrons(scene: Scene, mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return noisy frames as a perfect calibration of the raw ones would, (frames, rows, columns) [e-].

    Drawn for the mean photo-electrons `mean_e` of the same shape, in float32, they are without pedestal and
    dark, divided by the flat and not rounded to whole ADU. The sky is in them.
    """
    pixels, detector = pixels_of(scene, mean_e.mean(axis=0, dtype=np.float64)), scene.detector
    top_e = (detector.saturation_adu - detector.pedestal_adu) * detector.e_per_adu

    def read_e() -> np.ndarray:
        signal_e = pixels.signal_e(mean_e / pixels.reads, detector.read_noise_e, rng)
        return pixels.read(np.minimum(signal_e, top_e), pixels.stuck_e) - pixels.dark_e * pixels.response

    flat = flat_map(detector, scene.window)
    # dead pixels keep what they read
    return (_summed(read_e, pixels.reads) / np.where(flat > 0, flat, 1.0)).astype(np.float32)


@dataclass(frozen=True)
class Readout:
    """Turns the mean images of one recording into what its files hold.

    `pedestal_adu`, (rows, columns), is the level of each pixel without light.
    """

    pixels: Pixels
    pedestal_adu: np.ndarray

    @classmethod
    def of(cls, scene: Scene, mean_image_e: np.ndarray) -> "Readout":
        """Return the read-out of a `scene` with the mean image `mean_image_e`, (rows, columns) [e-].

        Raises `ConfigurationError` when read noise and gain contradict each other.
        """
        _ = scene.detector.analogue_noise_e
        return cls(pixels_of(scene, mean_image_e), pedestal_map_adu(scene.detector, scene.window))

    @property
    def top_adu(self) -> int:
        """Return the highest value of a raw frame [ADU]."""
        return self.pixels.reads * int(min(self.pixels.detector.saturation_adu, ADC_TOP_ADU))

    def frames_adu(self, mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return raw frames of mean light `mean_e`, (..., rows, columns) [e-], with noise of `rng`.

        They are uint16, or the sum of several reads as int32 [ADU].
        """
        pixels = self.pixels

        def read_adu() -> np.ndarray:
            signal_e = pixels.signal_e(mean_e / pixels.reads, pixels.detector.analogue_noise_e, rng)
            return pixels.read(self._converted(signal_e), self._converted(pixels.stuck_e))

        return _summed(read_adu, pixels.reads)

    def dark_adu(self, rng: np.random.Generator) -> np.ndarray:
        """Return the mean of `DARK_FRAMES` raw frames without light, (rows, columns) float32 [ADU]."""
        pixels, reads, detector = self.pixels, self.pixels.reads, self.pixels.detector
        noise_e = detector.analogue_noise_e
        if reads == 1:
            counts = rng.poisson(np.broadcast_to(pixels.dark_e, (DARK_FRAMES, *pixels.dark_e.shape)))
            multiplied_e = multiplied(counts, detector.excess_noise_factor, rng)
            signal_e = pixels.analogue_e(multiplied_e, noise_e, rng)
            return self._converted(signal_e).mean(axis=0, dtype=np.float64).astype(np.float32)
        # the mean of thousands of reads is normal; to draw each would take longer than all frames of a star
        mean_e = pixels.dark_e * pixels.response
        charge_e2 = detector.excess_noise_factor * pixels.dark_e * pixels.response**2
        variance_e2 = charge_e2 + detector.read_noise_e**2
        error_e = np.sqrt(variance_e2 / (DARK_FRAMES * reads)) * rng.standard_normal(mean_e.shape)
        dark_adu = reads * ((mean_e + error_e) / detector.e_per_adu + self.pedestal_adu)
        return dark_adu.astype(np.float32)

    def flat(self, rng: np.random.Generator) -> np.ndarray | None:
        """Return the relative response as the flat shows it, (rows, columns) float32; None if uniform."""
        if self.pixels.detector.flat_rms == 0:
            return None
        flat = flat_map(self.pixels.detector, self.pedestal_adu.shape)
        return (flat * (1 + FLAT_ERROR * rng.standard_normal(flat.shape))).astype(np.float32)

    def dead(self) -> np.ndarray:
        """Return the map of dead pixels, (rows, columns) uint8: 1 is dead."""
        return marked(self.pixels.detector.dead, self.pedestal_adu.shape).astype(np.uint8)

    def _converted(self, signal_e: np.ndarray) -> np.ndarray:
        level_adu = np.rint(np.nan_to_num(signal_e) / self.pixels.detector.e_per_adu + self.pedestal_adu)
        return np.clip(level_adu, 0, self.top_adu // self.pixels.reads).astype(np.uint16)


def _summed(read: Callable[[], np.ndarray], reads: int) -> np.ndarray:
    """Add up `reads` results of `read`; whole ADU become int32, which 32 000 reads cannot fill."""
    first = read()
    if reads == 1:
        return first
    total = first.astype(np.int32 if first.dtype.kind in "iu" else first.dtype)
    for _ in range(reads - 1):
        total += read()
    return total
