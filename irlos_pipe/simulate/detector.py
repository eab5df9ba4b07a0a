"""Constants of the infrared detector."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from irlos_pipe.conventions.keys import Limited, key, named_row
from irlos_pipe.conventions.reads import whole_reads
from irlos_pipe.simulate.errors import SceneError

ADC_TOP_ADU = 65535.0
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
