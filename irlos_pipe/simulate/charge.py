"""The pixels: from photo-electrons to the signal at the converter.

The order is that of the hardware, an HgCdTe avalanche photodiode array (SAPHIRA):

1. Photo-electrons *diffuse* to the neighbours before they are multiplied. Each goes its own way, so
   the counts stay Poissonian and uncorrelated about the diffused mean. Dark current is added here.
2. The number of electrons is drawn (Poisson).
3. Each is multiplied on its own. With gamma-distributed gains of mean 1 and variance F - 1 the sum
   of n of them is gamma-distributed with shape n/(F - 1): variance F n, and never negative. The mean
   gain differs from pixel to pixel, which is what the flat shows, with an error where one is given.
4. Inter-pixel capacitance induces a part of the multiplied signal in the neighbours, noise included.
5. The capacitance of the node grows with its charge: response ``s (1 - k s)``, then the full well.
6. The source follower and the amplifier add the read noise; what was left of pedestal or
   background since the dark was taken adds here, without shot noise.

The response of a pixel (3) thus acts before the non-linearity (5): dividing by the flat undoes it
exactly for a linear detector only, as in reality.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import convolve

from irlos_pipe.simulate.detector import DetectorModel, marked
from irlos_pipe.simulate.pattern_noise import Pattern

NEIGHBOURS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4
PEDESTAL_STREAM, FLAT_STREAM, FLAT_ERROR_STREAM = 0, 1, 2  # of a detector's `pattern_seed`


@dataclass(frozen=True)
class Pixels:
    """The pixels of one recording; all charges are those of one read.

    Attributes
    ----------
    detector : DetectorModel
    response : ndarray, (rows, columns)
        Mean gain, 1 on average; 0 in dead pixels.
    dark_e : ndarray, (rows, columns)
        Mean dark charge per read, as the dark image shows it [e-].
    diffusion : float
        Charge that leaves a pixel for its four neighbours, fraction.
    nonlinearity_per_e : float
        k of the response ``s (1 - k s)`` [1/e-].
    hot_e, background_e : ndarray, (rows, columns)
        Mean charge of hot pixels per read, and what is left of pedestal or background, neither of which
        the dark image shows [e-].
    alive : ndarray, (rows, columns)
        0 in pixels that died after the map of dead pixels was made.
    stuck_e : ndarray, (rows, columns)
        Constant reading above the pedestal; NaN where the pixel works [e-].
    reads : int
        That are added up to a frame.
    sky_e : float
        Mean light of the sky per read [e-].
    pattern : Pattern or None
        Noise that pixels of a row or column share.
    """

    detector: DetectorModel
    response: np.ndarray
    dark_e: np.ndarray
    diffusion: float
    nonlinearity_per_e: float
    hot_e: np.ndarray
    background_e: np.ndarray
    alive: np.ndarray
    stuck_e: np.ndarray
    reads: int = 1
    sky_e: float = 0.0
    pattern: Pattern | None = None

    def signal_e(self, mean_e: np.ndarray, read_noise_e: float, rng: np.random.Generator) -> np.ndarray:
        """Return the signal of one read at the converter [e-].

        Parameters
        ----------
        mean_e : ndarray, (..., rows, columns)
            Mean photo-electrons of the star per read.
        read_noise_e : float
        rng : numpy.random.Generator
        """
        light_e = shared(mean_e + self.sky_e, self.diffusion) + self.hot_e
        multiplied_e = multiplied(rng.poisson(light_e + self.dark_e), self.detector.excess_noise_factor, rng)
        return self._analogue_e(multiplied_e * self.alive, read_noise_e, rng) + self.background_e

    def dark_signal_e(self, frames: int, read_noise_e: float, rng: np.random.Generator) -> np.ndarray:
        """Return the signal of reads without light, before the effects came, (frames, rows, columns) [e-].

        Parameters
        ----------
        frames : int
        read_noise_e : float
        rng : numpy.random.Generator
        """
        counts = rng.poisson(np.broadcast_to(self.dark_e, (frames, *self.dark_e.shape)))
        return self._analogue_e(multiplied(counts, self.detector.excess_noise_factor, rng), read_noise_e, rng)

    def dark_moments_e(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean [e-] and variance [e-²] of a read without light, before the effects came."""
        charge_e2 = self.detector.excess_noise_factor * self.dark_e * self.response**2
        return self.dark_e * self.response, charge_e2 + self.detector.read_noise_e**2

    def read(self, values: np.ndarray, stuck: np.ndarray) -> np.ndarray:
        """Return frames (..., rows, columns) of `values` with the constant readings of `stuck` pixels."""
        return np.where(np.isnan(self.stuck_e), values, stuck)

    def _analogue_e(
        self, multiplied_e: np.ndarray, read_noise_e: float, rng: np.random.Generator
    ) -> np.ndarray:
        induced_e = shared(multiplied_e * self.response, self.detector.coupling_fraction)
        node_e = compressed(induced_e, self.nonlinearity_per_e, self.detector.full_well_e or np.inf)
        noise_e = read_noise_e * rng.standard_normal(node_e.shape)
        return (
            node_e + noise_e
            if self.pattern is None
            else node_e + noise_e + self.pattern.drawn_e(node_e.shape, rng)
        )


def nominal_pixels(
    detector: DetectorModel, window: tuple[int, int], exposure_s: float, sky_e_per_s: float = 0.0
) -> Pixels:
    """Return the pixels of a `detector` without effects.

    Parameters
    ----------
    detector : DetectorModel
    window : (int, int)
        Rows and columns [px].
    exposure_s : float
        Of a frame.
    sky_e_per_s : float
        Light of the sky in every pixel.
    """
    reads = detector.reads(exposure_s)
    read_s = exposure_s / reads
    return Pixels(
        detector,
        response_map(detector, window),
        dark_map_e(detector, window, read_s),
        detector.crosstalk_fraction,
        detector.nonlinearity_per_e,
        hot_e=np.zeros(window),
        background_e=np.zeros(window),
        alive=np.ones(window),
        stuck_e=np.full(window, np.nan),
        reads=reads,
        sky_e=sky_e_per_s * read_s,
    )


def shared(charge_e: np.ndarray, fraction: float) -> np.ndarray:
    """Give `fraction` of each pixel to its four neighbours; the window is continued by its edge.

    Parameters
    ----------
    charge_e : ndarray, (..., rows, columns)
        Charge [e-].
    fraction : float
    """
    charge_e = np.asarray(charge_e, dtype=np.float64)
    if fraction == 0:
        return charge_e
    kernel = NEIGHBOURS.reshape((1,) * (charge_e.ndim - 2) + NEIGHBOURS.shape)
    return (1 - fraction) * charge_e + fraction * convolve(charge_e, kernel, mode="nearest")


def multiplied(counts: np.ndarray, excess_noise_factor: float, rng: np.random.Generator) -> np.ndarray:
    """Multiply whole electrons by avalanches of mean gain 1.

    Parameters
    ----------
    counts : ndarray of int
    excess_noise_factor : float
        F, variance of the result over the Poisson variance.
    rng : numpy.random.Generator
    """
    spread = excess_noise_factor - 1
    return counts.astype(float) if spread == 0 else rng.gamma(counts / spread, spread)


def compressed(signal_e: np.ndarray, nonlinearity_per_e: float, full_well_e: float) -> np.ndarray:
    """Return ``s (1 - k s)``, held where it would turn down, and at the full well.

    Parameters
    ----------
    signal_e : ndarray
        s [e-].
    nonlinearity_per_e : float
        k [1/e-].
    full_well_e : float
    """
    turn_e = 0.5 / nonlinearity_per_e if nonlinearity_per_e > 0 else np.inf
    held_e = np.minimum(signal_e, turn_e)
    return np.minimum(held_e * (1 - nonlinearity_per_e * held_e), full_well_e)


def flat_map(detector: DetectorModel, window: tuple[int, int]) -> np.ndarray:
    """Return the part of the relative gain of each pixel that the flat shows; 0 in dead pixels.

    Parameters
    ----------
    detector : DetectorModel
    window : (int, int)
        Rows and columns [px].
    """
    gain = _scattered(detector.flat_rms, detector, window, FLAT_STREAM)
    return np.where(marked(detector.dead, window), 0.0, gain)


def response_map(detector: DetectorModel, window: tuple[int, int]) -> np.ndarray:
    """Return the relative gain of each pixel of the `detector` in a `window`; 0 in dead pixels."""
    error = _scattered(detector.flat_error_rms, detector, window, FLAT_ERROR_STREAM)
    return flat_map(detector, window) * error


def _scattered(rms: float, detector: DetectorModel, window: tuple[int, int], stream: int) -> np.ndarray:
    rng = np.random.default_rng([detector.pattern_seed, stream])
    return np.maximum(1 + rms * rng.standard_normal(window), 0.0)


def pedestal_map_adu(detector: DetectorModel, window: tuple[int, int]) -> np.ndarray:
    """Return the level of each pixel of the `detector` in a `window` without light [ADU]."""
    rng = np.random.default_rng([detector.pattern_seed, PEDESTAL_STREAM])
    return detector.pedestal_adu + detector.fixed_pattern_adu * rng.standard_normal(window)


def dark_map_e(detector: DetectorModel, window: tuple[int, int], exposure_s: float) -> np.ndarray:
    """Return the mean dark charge of each pixel of the `detector` in a `window` after `exposure_s` [e-]."""
    dark_e = np.full(window, detector.dark_e_per_s * exposure_s)
    for pixel, e_per_s in detector.hot_e_per_s:
        dark_e[tuple(pixel)] += e_per_s * exposure_s
    return dark_e
