"""The infrared detector: photons to ADU, with its defects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

ADU_MAX = 65535
FIXED_PATTERN_ADU = 1.0
DARK_FRAMES = 64
Pixel = tuple[int, int]


@dataclass(frozen=True)
class Detector:
    """Properties of the detector; pixels are (row, column)."""

    e_per_adu: float
    read_noise_e: float = 1.0  # of a pixel without light, quantisation included, RMS per frame
    pedestal_adu: float = 32.0  # electronic level without light; it carries no shot noise
    excess_noise_factor: float = 1.0  # variance of the signal over Poisson's; SAPHIRA's is claimed to be 1.25
    dead: tuple[Pixel, ...] = ()
    hot_e_per_s: tuple[tuple[Pixel, float], ...] = ()  # pixels with a dark current
    hot_after_dark_e_per_s: tuple[tuple[Pixel, float], ...] = ()  # those that became hot after the dark

    @property
    def analogue_noise_e(self) -> float:
        """Read noise before the conversion to whole ADU [e- RMS]."""
        return float(np.sqrt(self.read_noise_e**2 - self.e_per_adu**2 / 12))

    def pedestal_map_adu(self, window_px: int, rng: np.random.Generator) -> np.ndarray:
        """Return the level of each pixel without light, (window_px, window_px) [ADU]."""
        return self.pedestal_adu + FIXED_PATTERN_ADU * rng.standard_normal((window_px, window_px))

    def read_out(
        self, mean_e: np.ndarray, pedestal_adu: np.ndarray, exposure_s: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Return one raw frame (rows, columns) uint16 [ADU] for a mean photo-signal (rows, columns) [e-]."""
        charge_e = self._with_defects(mean_e, exposure_s)
        excess_e = np.sqrt((self.excess_noise_factor - 1) * charge_e)
        signal_e = rng.poisson(charge_e) + excess_e * rng.standard_normal(charge_e.shape)
        signal_e = signal_e + self.analogue_noise_e * rng.standard_normal(charge_e.shape)
        return np.clip(np.rint(signal_e / self.e_per_adu + pedestal_adu), 0, ADU_MAX).astype(np.uint16)

    def dark_adu(self, pedestal_adu: np.ndarray, exposure_s: float, rng: np.random.Generator) -> np.ndarray:
        """Return the mean of DARK_FRAMES frames without light, float32 [ADU]."""
        before = replace(self, hot_after_dark_e_per_s=())
        nothing_e = np.zeros_like(pedestal_adu)
        frames = [before.read_out(nothing_e, pedestal_adu, exposure_s, rng) for _ in range(DARK_FRAMES)]
        return np.mean(frames, axis=0, dtype=np.float64).astype(np.float32)

    def _with_defects(self, mean_e: np.ndarray, exposure_s: float) -> np.ndarray:
        charge_e = np.array(mean_e, dtype=float)
        for pixel in self.dead:
            charge_e[pixel] = 0.0
        for pixel, current_e_per_s in self.hot_e_per_s + self.hot_after_dark_e_per_s:
            charge_e[pixel] += current_e_per_s * exposure_s
        return charge_e
