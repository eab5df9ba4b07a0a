"""Effects of the detector; the dark, the flat and the map of dead pixels do not show them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from irlos_pipe.conventions.keys import key
from irlos_pipe.simulate.detector import Axis, Pattern, Pixel, Pixels, marked, outside_window, shared
from irlos_pipe.simulate.effects.base import SimulatedEffect

Kind = Literal["hot", "dead", "stuck"]


@dataclass(frozen=True)
class InterpixelCrosstalk(SimulatedEffect):
    """A further `fraction` of the charge diffuses to the four neighbours before the multiplication."""

    name = "interpixel_crosstalk"
    fraction: float

    def on(self, pixels: Pixels, mean_image_e: np.ndarray) -> Pixels:
        return replace(pixels, diffusion=pixels.diffusion + self.fraction)


@dataclass(frozen=True)
class DetectorNonlinearity(SimulatedEffect):
    """A further bend of the response, stated as the `fraction_at_peak` that the mean image's peak loses."""

    name = "detector_nonlinearity"
    fraction_at_peak: float = key(ge=-0.4, le=0.5)

    def on(self, pixels: Pixels, mean_image_e: np.ndarray) -> Pixels:
        peak_e = float(shared(mean_image_e, pixels.diffusion).max())
        bend_per_e = self.fraction_at_peak / peak_e if peak_e > 0 else 0.0
        return replace(pixels, nonlinearity_per_e=pixels.nonlinearity_per_e + bend_per_e)


@dataclass(frozen=True)
class BackgroundGradient(SimulatedEffect):
    """A plane left of pedestal or background: `level_e`, rising by `e_per_pixel` towards `angle_deg`."""

    name = "background_gradient"
    e_per_pixel: float = key(0.0, ge=-1e5, le=1e6)
    angle_deg: float = 0.0
    level_e: float = key(0.0, "e- per frame, at the centre", ge=-1e6, le=1e6)

    def on(self, pixels: Pixels, mean_image_e: np.ndarray) -> Pixels:
        angle = np.deg2rad(self.angle_deg)
        y, x = (np.arange(size) - (size - 1) / 2 for size in pixels.response.shape)
        plane = np.cos(angle) * x + np.sin(angle) * y[:, None]
        return replace(pixels, background_e=(self.level_e + self.e_per_pixel * plane) / pixels.reads)


@dataclass(frozen=True)
class CorrelatedNoise(SimulatedEffect):
    """Stripes of `e_rms` per frame that differ from read to read: 1/f noise, or a tone of `period_px`."""

    name = "correlated_noise"
    e_rms: float
    axis: Axis = "rows"
    period_px: float | None = None

    def on(self, pixels: Pixels, mean_image_e: np.ndarray) -> Pixels:
        """Return the `pixels` with stripes of one read; those of independent reads add up in variance."""
        of_one = self.e_rms / np.sqrt(pixels.reads)
        return replace(pixels, pattern=Pattern(float(of_one), self.axis, self.period_px))


@dataclass(frozen=True)
class BadPixels(SimulatedEffect):
    """Pixels, (row, column) each, that went bad after the calibration images were taken.

    `level_e` is the mean charge of hot ones per frame, or the constant reading of stuck ones above the
    pedestal [e-].
    """

    name = "bad_pixels"
    pixels: Sequence[Pixel]
    kind: Kind = "hot"
    level_e: float = key(1000.0, "e- per frame, of hot and stuck pixels", ge=0.0, le=1e6)

    def misfit(self, scene: Any) -> str:
        return outside_window("effects.bad_pixels", self.pixels, scene.window)

    def on(self, pixels: Pixels, mean_image_e: np.ndarray) -> Pixels:
        bad, level_e = marked(self.pixels, pixels.response.shape), self.level_e / pixels.reads
        if self.kind == "hot":
            return replace(pixels, hot_e=np.where(bad, level_e, 0.0))
        if self.kind == "dead":
            return replace(pixels, alive=np.where(bad, 0.0, 1.0))
        return replace(pixels, stuck_e=np.where(bad, level_e, np.nan))
