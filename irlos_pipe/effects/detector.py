"""The detector: cross-talk, non-linearity, a gradient, correlated noise, bad pixels."""

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.effects.base import FixedEffect
from irlos_pipe.effects.declaration import Calibrated, Conditions, Parameter, Public, direction
from irlos_pipe.effects.planes import DetectorEffect
from irlos_pipe.effects.public_values import components, size_and_angle

NEIGHBOURS = ((0, 1), (2, 1), (1, 0), (1, 2))  # offsets in an image padded by one pixel


class InterpixelCrosstalk(DetectorEffect):
    """Charge that diffuses, or couples by capacitance, to the four neighbours.

    A pixel keeps ``1 - fraction`` and gives each neighbour a quarter of the rest; beyond the window the
    image goes on as at its edge.
    """

    name = "interpixel_crosstalk"
    formula = "s → (1 − f) s + ¼ f · (sum of the four neighbours), f = fraction"
    mild = True
    order = 0
    public = (Public("fraction", "shared with the four neighbours together", 0.0, 0.8),)
    blurs = "detector"
    sentence = "charge shared between pixels, {fraction:.2%}"
    look_alike = "tip_tilt_jitter, which moves the centroids of single frames"
    reference = "Moore, Ninkov & Forrest 2006, Opt. Eng. 45, 076402; Finger et al. 2006, SPIE 6276, 62760F"
    parameters = (Parameter("fraction", "", 0.02, lower=0.0, upper=0.8, plausible=(0.0, 0.2)),)

    def apply(self, values: Tensor, images_e: Tensor) -> Tensor:
        rows, columns = images_e.shape[-2:]
        shape = (-1, 1, rows, columns)
        padded = torch.nn.functional.pad(images_e.reshape(shape), (1, 1, 1, 1), mode="replicate")
        neighbours = (padded[..., r : r + rows, c : c + columns] for r, c in NEIGHBOURS)
        received = reduce(torch.add, neighbours) / 4
        return images_e + values[0] * (received.reshape(images_e.shape) - images_e)

    def pushed(self, values: Tensor, images_e: Tensor, changes: Tensor) -> Tensor:
        return self.apply(values, changes)


class DetectorNonlinearity(DetectorEffect):
    """The node's capacitance grows with its charge: ``s (1 - f s / s_peak)``.

    Parameters: `peak_e`, signal at which the fraction is stated; by default that of the brightest pixel of
    each image.
    """

    name = "detector_nonlinearity"
    formula = "s → s (1 − f s / s_peak), f = fraction_at_peak"
    mild = True
    order = 1
    public = (Public("fraction_at_peak", "lost at the brightest pixel of the mean image", -0.4, 0.4),)
    sentence = "a loss of {fraction_at_peak:.1%} at the brightest pixel"
    look_alike = "tip_tilt_jitter, which conserves the light; a fainter star distinguishes them"
    reference = "Plazas et al. 2017, JINST 12, C04009"
    parameters = (Parameter("fraction_at_peak", "", 0.0, 0.0, 0.1, -0.4, 0.4, plausible=(-0.05, 0.35)),)

    def __init__(self, peak_e: float | None = None):
        self.peak_e = peak_e

    def handed_on(self, values: np.ndarray, now: Conditions, then: Calibrated) -> FixedEffect:
        """See `Effect.handed_on`: stated at the brightest pixel of the calibration, before it was bent."""
        return FixedEffect(DetectorNonlinearity(then.brightest_e / (1 - values[0])), values)

    def apply(self, values: Tensor, images_e: Tensor) -> Tensor:
        peak = images_e.amax((-2, -1), keepdim=True) if self.peak_e is None else self.peak_e
        return images_e * (1 - values[0] * images_e / peak)

    def pushed(self, values: Tensor, images_e: Tensor, changes: Tensor) -> Tensor:
        """See `DetectorEffect.pushed`: the brightest pixel changes as well."""
        images, lost = images_e[:, None], values[0]
        if self.peak_e is not None:
            return changes * (1 - 2 * lost / self.peak_e * images)
        part = images / images.amax((-2, -1), keepdim=True)
        brightest = images_e.flatten(1).argmax(1)[:, None, None].expand(-1, changes.shape[1], 1)
        of_peak = changes.flatten(2).gather(2, brightest)[..., None]
        return changes * (1 - 2 * lost * part) + lost * part**2 * of_peak


class BackgroundGradient(DetectorEffect):
    """A slope that dark and sky subtraction left; the pedestal is the background of every fit.

    Added after the detector's response, zero in the middle of the window.
    """

    name = "background_gradient"
    formula = (
        "s → s + e_per_pixel · (x cos angle_deg + y sin angle_deg), x and y in pixels from the middle of "
        "the window"
    )
    belongs_to = "moment"
    mild = True
    order = 2
    instrumental = False
    public = (
        Public("e_per_pixel", "e-/px", 0.0, 1e6),
        direction("angle_deg", "deg from +x towards +y, uphill"),
    )
    sentence = "a background slope of {e_per_pixel:.2g} e⁻/px towards {angle_deg:.0f}°"
    look_alike = "seeing_halo stretched by coma, which falls off with distance"
    reference = "Bertin & Arnouts 1996, A&AS 117, 393"
    parameters = (
        Parameter("x_e_per_px", "e-/px", 0.0),
        Parameter("y_e_per_px", "e-/px", 0.0),
    )

    def apply(self, values: Tensor, images_e: Tensor) -> Tensor:
        y, x = (
            torch.arange(size, dtype=torch.float64, device=images_e.device) - (size - 1) / 2
            for size in images_e.shape[-2:]
        )
        return images_e + values[0] * x[None, :] + values[1] * y[:, None]

    def describe(self, values: np.ndarray) -> dict[str, float]:
        return dict(zip(("e_per_pixel", "angle_deg"), size_and_angle(*values), strict=True))

    def values_of(self, e_per_pixel: float, angle_deg: float) -> list[float]:
        return components(e_per_pixel, angle_deg)


class CorrelatedNoise(DetectorEffect):
    """Noise that the pixels of a row or column share: pick-up in the read-out chain.

    It differs from frame to frame and has no mean, so that it is no part of an image but of its noise: errors
    that rest on the scatter of frames contain it, those of a noise model do not.
    """

    name = "correlated_noise"
    formula = "s → s + n, the same along a row or column, ⟨n⟩ = 0, ⟨n²⟩ = e_rms²"
    belongs_to = "moment"
    order = 4
    instrumental = False
    found_by = "noise"
    public = (
        Public("e_rms", "e- per frame", 0.0, 1e6),
        Public("axis", "pixels that are alike", kind="word", required=False, choices=("rows", "columns")),
        Public("period_px", "px across the stripes; 1/f noise if left out", 2.0, 1e4, required=False),
    )
    sentence = "noise of {e_rms:.2g} e⁻ that rows or columns share"
    look_alike = "background_gradient, which does not change; read noise, which no two pixels share"
    reference = "Moseley et al. 2010, SPIE 7742, 77421B"
    parameters = (Parameter("e_rms", "e-", 0.0, lower=0.0, upper=1e6),)

    def __init__(self, axis: str = "rows", period_px: float | None = None):
        self.axis, self.period_px = axis, period_px

    def apply(self, values: Tensor, images_e: Tensor) -> Tensor:
        """See `DetectorEffect.apply`: the mean image is what it was."""
        return images_e

    def describe(self, values: np.ndarray) -> dict[str, Any]:
        period = {} if self.period_px is None else {"period_px": self.period_px}
        return {"e_rms": float(values[0]), "axis": self.axis, **period}

    @classmethod
    def options_for(cls, **public: Any) -> dict[str, Any]:
        """Axis and period, which are not estimated."""
        return {name: value for name, value in public.items() if name != "e_rms"}

    def values_of(self, e_rms: float, axis: str = "rows", period_px: float | None = None) -> list[float]:
        return [e_rms]


MOST_E = 1e6  # signal of a pixel, more than any detector holds


class BadPixels(DetectorEffect):
    """Hot, dead or stuck pixels that the map of dead pixels does not list.

    What such a pixel shows is no function of the light, so each has an offset of its own: fitting it
    is the same as masking the pixel.

    Parameters: `pixels`, (row, column) each.
    """

    name = "bad_pixels"
    formula = "s_p → s_p + offset_p for every pixel p listed"
    order = 3
    public = (Public("pixels", "[row, column]", kind="pixels"),)
    found_by = "pixels"
    look_alike = "a companion, or whatever else a single pixel pulls at; its course in time is not the star's"
    reference = "Baarda 1968, A testing procedure for use in geodetic networks (data snooping)"

    def __init__(self, pixels: Sequence[Sequence[int]] = ()):
        self.pixels = tuple((int(row), int(column)) for row, column in pixels)
        self.parameters = tuple(
            Parameter(f"excess_{row}_{column}_e", "e-", 0.0, plausible=(-MOST_E, MOST_E))
            for row, column in self.pixels
        )

    @classmethod
    def options_for(cls, **public: Any) -> dict[str, Any]:
        return dict(public)

    @classmethod
    def under(cls, conditions: Conditions, pixels: Sequence[Sequence[int]] = ()) -> "BadPixels":
        rows, columns = conditions.settings.window
        outside = [list(pixel) for pixel in pixels if not (pixel[0] < rows and pixel[1] < columns)]
        if outside:
            raise ValueError(f"pixels {outside} lie outside the window of {rows} x {columns}")
        return cls(pixels)

    def apply(self, values: Tensor, images_e: Tensor) -> Tensor:
        rows, columns = images_e.shape[-2:]
        for value, (row, column) in zip(values, self.pixels, strict=True):
            there = torch.zeros(rows, columns, dtype=torch.float64, device=images_e.device)
            there[row, column] = 1
            images_e = images_e + value * there
        return images_e

    def good_pixels(self, window: tuple[int, int]) -> np.ndarray:
        good = np.ones(window, dtype=bool)
        for pixel in self.pixels:
            good[pixel] = False
        return good

    def describe(self, values: np.ndarray) -> dict[str, list[list[int]]]:
        return {"pixels": [list(pixel) for pixel in self.pixels]}

    def phrase(self, public: Mapping[str, Any]) -> str:
        places = [f"row {row}, column {column}" for row, column in public["pixels"]]
        return (
            f"{'a bad pixel' if len(places) == 1 else 'bad pixels'} at {'; '.join(places)} (counted from 0)"
        )

    def values_of(self, pixels: Sequence[Sequence[int]]) -> list[float]:
        """Nothing in excess: the pixels are masked."""
        return [0.0] * len(self.pixels)
