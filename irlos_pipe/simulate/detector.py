"""The infrared detector: its constants, and its pixels from photo-electrons to the signal at the converter.

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

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from scipy.ndimage import convolve

from irlos_pipe.conventions.keys import Limited, key, named_row
from irlos_pipe.conventions.reads import whole_reads
from irlos_pipe.simulate import SceneError

ADC_TOP_ADU = 65535.0
NEIGHBOURS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4
PEDESTAL_STREAM, FLAT_STREAM, FLAT_ERROR_STREAM = 0, 1, 2  # of a detector's `pattern_seed`
Axis = Literal["rows", "columns"]
Index = Annotated[int, Limited(ge=0, lt=4096)]
Pixel = tuple[Index, Index]  # row, column


@named_row
class HotPixel(NamedTuple):
    """A pixel with a dark current of its own."""

    pixel: Annotated[Pixel, Limited("[row, column]")]
    e_per_s: Annotated[float, Limited("dark current", ge=0, le=1e9)]


@dataclass(frozen=True)
class DetectorModel:
    """An avalanche photodiode array (SAPHIRA); pixels are (row, column), electrons are photo-electrons.

    The gain includes that of the avalanche; the excess noise factor is claimed to be 1.25, 1.47 was measured.
    Diffusion acts before the multiplication, the coupling (inter-pixel capacitance) after it: the one leaves
    the noise of neighbours independent, the other correlates it. Raw frames end at 65535 in any case.
    """

    e_per_adu: float = key(0.5, "photo-electrons per ADU", gt=0, le=1000)
    read_noise_e: float = key(1.0, "RMS per pixel and read, rounding included", ge=0, le=1000)
    pedestal_adu: float = key(200.0, "level without light", ge=0, le=60000)
    fixed_pattern_adu: float = key(0.0, "scatter of the level between pixels", ge=0, le=5000)
    excess_noise_factor: float = key(1.0, "photon variance over Poisson's", ge=1, le=5)
    flat_rms: float = key(0.0, "scatter of the gain between pixels, relative", ge=0, le=0.5)
    flat_error_rms: float = key(0.0, "scatter of the gain that no flat shows", ge=0, le=0.5)
    dark_e_per_s: float = key(0.0, "dark current of every pixel", ge=0, le=1e6)
    dead: tuple[Pixel, ...] = key((), "[row, column] of pixels that the map of dead pixels shows")
    hot_e_per_s: tuple[HotPixel, ...] = key((), "pixels that the dark shows: {pixel, e_per_s}", alias="hot")
    crosstalk_fraction: float = key(0.0, "charge diffusing to the 4 neighbours", ge=0, le=0.5)
    coupling_fraction: float = key(0.0, "signal induced in the 4 neighbours", ge=0, le=0.5)
    nonlinearity_per_e: float = key(0.0, "k of the response s (1 - k s)", ge=0, le=1e-3)
    full_well_e: float | None = key(None, "signal at which a pixel stops collecting", gt=0)
    saturation_adu: float = key(float("inf"), "end of the converter", gt=0, le=ADC_TOP_ADU)
    pattern_seed: int = key(0, "seed of what is fixed in the detector", ge=0)
    read_s: float | None = key(
        None, "exposure of a read, of which a frame is the sum; one read if left out", gt=0, le=600
    )

    def reads(self, exposure_s: float) -> int:
        """Return the number of reads that are added up to an exposure of `exposure_s`.

        Raises `ConfigurationError` when the exposure is no multiple of `read_s`.
        """
        return 1 if self.read_s is None else whole_reads(exposure_s, self.read_s)

    @property
    def analogue_noise_e(self) -> float:
        """Read noise before rounding to whole ADU, which adds ``e_per_adu / sqrt(12)`` [e- RMS].

        Raises `ConfigurationError` when rounding alone is noisier than `read_noise_e`.
        """
        rest_e2 = self.read_noise_e**2 - self.e_per_adu**2 / 12
        if rest_e2 < 0:
            raise SceneError(
                f"read_noise_e = {self.read_noise_e:g} is below the noise of rounding to whole ADU, "
                f"e_per_adu/sqrt(12) = {self.e_per_adu / 12**0.5:.3g} e-; raise it, or lower e_per_adu"
            )
        return float(np.sqrt(rest_e2))


def outside_window(where: str, pixels: Iterable[Pixel], window: tuple[int, int]) -> str:
    """Return which of the `pixels` given as `where` lies outside a `window`; empty if none does."""
    for pixel in pixels:
        if pixel[0] >= window[0] or pixel[1] >= window[1]:
            return f"{where}: pixel {list(pixel)} lies outside the window of {list(window)} (rows, columns)"
    return ""


def marked(pixels: Iterable[Pixel], window: tuple[int, ...]) -> np.ndarray:
    """Return True at the listed `pixels` (row, column), (rows, columns) as the `window` has."""
    mask = np.zeros(window, dtype=bool)
    for row, column in pixels:
        mask[row, column] = True
    return mask


@dataclass(frozen=True)
class Pattern:
    """Stripes that differ from read to read, of `e_rms` in one read [e-]: pick-up in the read-out chain.

    All pixels of a row, or of a column, have the same value. `period_px` is that of a tone across the
    stripes, whose phase is random in every read; None is 1/f noise, of which neighbouring stripes share most.
    """

    e_rms: float
    axis: Axis = "rows"
    period_px: float | None = None

    def drawn_e(self, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
        """Return stripes of reads (..., rows, columns) that broadcast to `shape`, drawn from `rng` [e-]."""
        *reads, rows, columns = shape
        size = rows if self.axis == "rows" else columns
        if self.period_px:
            phase = rng.uniform(0, 2 * np.pi, (*reads, 1))
            stripes = np.sqrt(2) * np.cos(2 * np.pi * np.arange(size) / self.period_px + phase)
        else:
            stripes = _pink((*reads, size), rng)
        return self.e_rms * (stripes[..., :, None] if self.axis == "rows" else stripes[..., None, :])


def _pink(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Series of unit variance with a power spectrum 1/f and no mean, along the last axis."""
    size = shape[-1]
    frequency = np.fft.rfftfreq(2 * size)[1:]  # twice as long: a window sees a part of the series
    modes = rng.standard_normal((*shape[:-1], len(frequency), 2)) @ np.array([1, 1j])
    spectrum = np.concatenate([np.zeros((*shape[:-1], 1)), modes / np.sqrt(frequency)], axis=-1)
    # each kept mode stands for its mirror image too; the last one, at Nyquist's frequency, for itself
    expected = 4 * np.sum(1 / frequency[:-1]) + 1 / frequency[-1]
    return np.fft.irfft(spectrum, n=2 * size, norm="forward")[..., :size] / np.sqrt(expected)


@dataclass(frozen=True)
class Pixels:
    """The pixels of one recording; maps are (rows, columns), and all charges are those of one read."""

    detector: DetectorModel
    response: np.ndarray  # mean gain, 1 on average; 0 in dead pixels
    dark_e: np.ndarray  # mean dark charge, as the dark image shows it
    diffusion: float  # charge that leaves a pixel for its four neighbours, fraction
    nonlinearity_per_e: float  # k of the response s (1 - k s)
    # mean charge of hot pixels, and what is left of pedestal or background: the dark image shows neither
    hot_e: np.ndarray
    background_e: np.ndarray
    alive: np.ndarray  # 0 in pixels that died after the map of dead pixels was made
    stuck_e: np.ndarray  # constant reading above the pedestal; NaN where the pixel works
    reads: int = 1  # that are added up to a frame
    sky_e: float = 0.0  # mean light of the sky
    pattern: Pattern | None = None  # noise that pixels of a row or column share

    def signal_e(self, mean_e: np.ndarray, read_noise_e: float, rng: np.random.Generator) -> np.ndarray:
        """Return the signal of one read at the converter [e-].

        The star gives `mean_e` photo-electrons per read, (..., rows, columns), on average; the read has a
        noise of `read_noise_e`, and what is random is drawn from `rng`.
        """
        light_e = shared(mean_e + self.sky_e, self.diffusion) + self.hot_e
        multiplied_e = multiplied(rng.poisson(light_e + self.dark_e), self.detector.excess_noise_factor, rng)
        return self.analogue_e(multiplied_e * self.alive, read_noise_e, rng) + self.background_e

    def read(self, values: np.ndarray, stuck: np.ndarray) -> np.ndarray:
        """Return frames (..., rows, columns) of `values` with the constant readings of `stuck` pixels."""
        return np.where(np.isnan(self.stuck_e), values, stuck)

    def analogue_e(
        self, multiplied_e: np.ndarray, read_noise_e: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Return what the converter gets of `multiplied_e` electrons [e-]; see `signal_e` for the others."""
        induced_e = shared(multiplied_e * self.response, self.detector.coupling_fraction)
        node_e = compressed(induced_e, self.nonlinearity_per_e, self.detector.full_well_e or np.inf)
        noise_e = read_noise_e * rng.standard_normal(node_e.shape)
        signal_e = node_e + noise_e
        return signal_e if self.pattern is None else signal_e + self.pattern.drawn_e(node_e.shape, rng)


def shared(charge_e: np.ndarray, fraction: float) -> np.ndarray:
    """Give `fraction` of the `charge_e` (..., rows, columns) of each pixel to its four neighbours.

    The window is continued by its edge.
    """
    charge_e = np.asarray(charge_e, dtype=np.float64)
    if fraction == 0:
        return charge_e
    kernel = NEIGHBOURS.reshape((1,) * (charge_e.ndim - 2) + NEIGHBOURS.shape)
    return (1 - fraction) * charge_e + fraction * convolve(charge_e, kernel, mode="nearest")


def multiplied(counts: np.ndarray, excess_noise_factor: float, rng: np.random.Generator) -> np.ndarray:
    """Multiply whole electrons by avalanches of mean gain 1, drawn from `rng`.

    The variance of the result is `excess_noise_factor` times the Poisson variance of the `counts`.
    """
    spread = excess_noise_factor - 1
    return counts.astype(float) if spread == 0 else rng.gamma(counts / spread, spread)


def compressed(signal_e: np.ndarray, nonlinearity_per_e: float, full_well_e: float) -> np.ndarray:
    """Return ``s (1 - k s)`` of `signal_e`, s, and `nonlinearity_per_e`, k [1/e-].

    It is held where it would turn down, and at `full_well_e`.
    """
    turn_e = 0.5 / nonlinearity_per_e if nonlinearity_per_e > 0 else np.inf
    held_e = np.minimum(signal_e, turn_e)
    return np.minimum(held_e * (1 - nonlinearity_per_e * held_e), full_well_e)


def flat_map(detector: DetectorModel, window: tuple[int, int]) -> np.ndarray:
    """Return the gain of each pixel of the `detector` in a `window`, as the flat shows it; 0 in dead ones."""
    gain = scattered(detector.flat_rms, detector, window, FLAT_STREAM)
    return np.where(marked(detector.dead, window), 0.0, gain)


def scattered(rms: float, detector: DetectorModel, window: tuple[int, int], stream: int) -> np.ndarray:
    """Return factors about one with a scatter of `rms`, by a `stream` of the seed of the `detector`."""
    rng = np.random.default_rng([detector.pattern_seed, stream])
    return np.maximum(1 + rms * rng.standard_normal(window), 0.0)


def pedestal_map_adu(detector: DetectorModel, window: tuple[int, int]) -> np.ndarray:
    """Return the level of each pixel of the `detector` in a `window` without light [ADU]."""
    rng = np.random.default_rng([detector.pattern_seed, PEDESTAL_STREAM])
    return detector.pedestal_adu + detector.fixed_pattern_adu * rng.standard_normal(window)
