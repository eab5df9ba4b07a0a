"""Constants of the infrared detector."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.reads import whole_reads

ADC_TOP_ADU = 65535.0
Pixel = tuple[int, int]


@dataclass(frozen=True)
class DetectorModel:
    """An avalanche photodiode array (SAPHIRA); pixels are (row, column), electrons are photo-electrons.

    Attributes
    ----------
    e_per_adu : float
        Gain [e-/ADU], avalanche gain included.
    read_noise_e : float
        Noise of a pixel without light, rounding to whole ADU included [e- RMS per read].
    read_s : float, optional
        Exposure of one read [s]; a frame is the sum of as many as fill its exposure. None: of one.
    pedestal_adu : float
        Electronic level without light; it carries no shot noise [ADU].
    fixed_pattern_adu : float
        Scatter of the pedestal from pixel to pixel [ADU RMS].
    excess_noise_factor : float
        F, variance of the photon signal over its Poisson variance; 1.25 is claimed, 1.47 measured.
    flat_rms : float
        Scatter of the avalanche gain from pixel to pixel, relative; the flat shows it.
    flat_error_rms : float
        Further scatter of the gain, relative, which the flat does not show.
    dark_e_per_s : float
        Dark current of every pixel [e-/s].
    dead : tuple of Pixel
        Pixels that do not respond to light; the map of dead pixels shows them.
    hot_e_per_s : tuple of (Pixel, float)
        Pixels with a dark current of their own [e-/s]; the dark image shows them.
    crosstalk_fraction : float
        Charge that diffuses from a pixel to its four neighbours together, before the multiplication.
    coupling_fraction : float
        Signal that a pixel induces in its four neighbours together (inter-pixel capacitance), after
        the multiplication: it correlates the noise, diffusion does not.
    nonlinearity_per_e : float
        k of the response ``s (1 - k s)`` [1/e-].
    full_well_e : float
        Signal at which a pixel stops collecting [e-].
    saturation_adu : float
        Level that nothing exceeds; raw frames end at 65535 in any case [ADU].
    pattern_seed : int
        Of everything that is fixed in the detector: pedestal and gain of each pixel.
    """

    e_per_adu: float = 0.5
    read_noise_e: float = 1.0
    pedestal_adu: float = 200.0
    fixed_pattern_adu: float = 0.0
    excess_noise_factor: float = 1.0
    flat_rms: float = 0.0
    flat_error_rms: float = 0.0
    dark_e_per_s: float = 0.0
    dead: tuple[Pixel, ...] = ()
    hot_e_per_s: tuple[tuple[Pixel, float], ...] = ()
    crosstalk_fraction: float = 0.0
    coupling_fraction: float = 0.0
    nonlinearity_per_e: float = 0.0
    full_well_e: float = float("inf")
    saturation_adu: float = float("inf")
    pattern_seed: int = 0
    read_s: float | None = None

    def reads(self, exposure_s: float) -> int:
        """Return the number of reads that are added up to an exposure of `exposure_s`.

        Raises
        ------
        ConfigurationError
            When the exposure is no multiple of `read_s`.
        """
        if self.read_s is None:
            return 1
        return whole_reads(exposure_s, self.read_s)

    @property
    def analogue_noise_e(self) -> float:
        """Read noise before rounding to whole ADU, which adds ``e_per_adu / sqrt(12)`` [e- RMS].

        Raises
        ------
        ConfigurationError
            When rounding alone is noisier than `read_noise_e`.
        """
        rest_e2 = self.read_noise_e**2 - self.e_per_adu**2 / 12
        if rest_e2 < 0:
            raise ConfigurationError(
                f"detector: read_noise_e = {self.read_noise_e:g} is below the noise of rounding, "
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
