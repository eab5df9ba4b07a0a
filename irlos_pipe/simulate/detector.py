"""The infrared detector: its constants, raw frames in ADU, and the electrons a calibration makes of them.

`irlos_pipe.simulate.pixels` argues the order of what happens between photon and converter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.simulate.late_defects import marked
from irlos_pipe.simulate.pixels import Pixels, pedestal_map_adu

if TYPE_CHECKING:
    from irlos_pipe.simulate.scene import Scene

ADC_TOP_ADU = 65535.0
DARK_FRAMES = 64  # averaged to the dark image
FLAT_ERROR = 1e-4  # of the measured flat, relative RMS
Pixel = tuple[int, int]


@dataclass(frozen=True)
class DetectorModel:
    """An avalanche photodiode array (SAPHIRA); pixels are (row, column), electrons are photo-electrons.

    Attributes
    ----------
    e_per_adu : float
        Gain [e-/ADU], avalanche gain included.
    read_noise_e : float
        Noise of a pixel without light, rounding to whole ADU included [e- RMS per frame].
    pedestal_adu : float
        Electronic level without light; it carries no shot noise [ADU].
    fixed_pattern_adu : float
        Scatter of the pedestal from pixel to pixel [ADU RMS].
    excess_noise_factor : float
        F, variance of the photon signal over its Poisson variance; 1.25 is claimed, 1.47 measured.
    flat_rms : float
        Scatter of the avalanche gain from pixel to pixel, relative.
    dark_e_per_s : float
        Dark current of every pixel [e-/s].
    dead : tuple of Pixel
        Pixels that do not respond to light; the map of dead pixels tells them.
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
    dark_e_per_s: float = 0.0
    dead: tuple[Pixel, ...] = ()
    hot_e_per_s: tuple[tuple[Pixel, float], ...] = ()
    crosstalk_fraction: float = 0.0
    coupling_fraction: float = 0.0
    nonlinearity_per_e: float = 0.0
    full_well_e: float = float("inf")
    saturation_adu: float = float("inf")
    pattern_seed: int = 0

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


def electrons(scene: Scene, mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Frames as a perfect calibration of the raw ones would return them: noisy electrons.

    Parameters
    ----------
    mean_e : ndarray, (frames, rows, columns)
        Mean photo-electrons.

    Returns
    -------
    ndarray, (frames, rows, columns), float32
        Without pedestal and dark, divided by the flat; not rounded to whole ADU [e-].
    """
    pixels, detector = Pixels.of(scene, mean_e.mean(axis=0, dtype=np.float64)), scene.detector
    signal_e = pixels.signal_e(mean_e, detector.read_noise_e, rng)
    top_e = (detector.saturation_adu - detector.pedestal_adu) * detector.e_per_adu
    read_e = pixels.late.read(np.minimum(signal_e, top_e), pixels.late.stuck_e)
    return _over_flat(read_e - pixels.dark_e * pixels.response, pixels.response).astype(np.float32)


@dataclass(frozen=True)
class Readout:
    """Turns the mean images of one recording into what its files hold.

    Attributes
    ----------
    pixels : Pixels
    pedestal_adu : ndarray, (rows, columns)
        Level of each pixel without light [ADU].
    """

    pixels: Pixels
    pedestal_adu: np.ndarray

    @classmethod
    def of(cls, scene: Scene, mean_image_e: np.ndarray) -> Readout:
        """Read-out of a scene whose mean image (rows, columns) [e-] is known.

        Raises
        ------
        ConfigurationError
            When read noise and gain contradict each other.
        """
        _ = scene.detector.analogue_noise_e
        return cls(Pixels.of(scene, mean_image_e), pedestal_map_adu(scene.detector, scene.window))

    @property
    def top_adu(self) -> int:
        """Highest value of a raw frame [ADU]."""
        return int(min(self.pixels.detector.saturation_adu, ADC_TOP_ADU))

    def frames_adu(self, mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Raw frames (..., rows, columns) uint16 for their mean photo-electrons [ADU]."""
        signal_e = self.pixels.signal_e(mean_e, self.pixels.detector.analogue_noise_e, rng)
        return self.pixels.late.read(self._converted(signal_e), self._converted(self.pixels.late.stuck_e))

    def dark_adu(self, rng: np.random.Generator) -> np.ndarray:
        """Dark image: mean of `DARK_FRAMES` raw frames without light, (rows, columns) float32 [ADU]."""
        signal_e = self.pixels.dark_signal_e(DARK_FRAMES, self.pixels.detector.analogue_noise_e, rng)
        return self._converted(signal_e).mean(axis=0, dtype=np.float64).astype(np.float32)

    def flat(self, rng: np.random.Generator) -> np.ndarray | None:
        """Relative response as measured, (rows, columns) float32; None for a uniform detector."""
        if self.pixels.detector.flat_rms == 0:
            return None
        error = 1 + FLAT_ERROR * rng.standard_normal(self.pixels.response.shape)
        return (self.pixels.response * error).astype(np.float32)

    def dead(self) -> np.ndarray:
        """Map of dead pixels, (rows, columns) uint8: 1 is dead."""
        return marked(self.pixels.detector.dead, self.pedestal_adu.shape).astype(np.uint8)

    def _converted(self, signal_e: np.ndarray) -> np.ndarray:
        level_adu = np.rint(np.nan_to_num(signal_e) / self.pixels.detector.e_per_adu + self.pedestal_adu)
        return np.clip(level_adu, 0, self.top_adu).astype(np.uint16)


def _over_flat(signal_e: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Divide by the response; dead pixels keep what they read."""
    return signal_e / np.where(response > 0, response, 1.0)
