"""Conversions between the units of the interfaces and SI."""

import math
from typing import Protocol, Self, TypeVar

NM = 1e-9  # one nanometre [m]
MAS = math.pi / 180 / 3600e3  # one milliarcsecond [rad]
MAS_PER_RAD = math.degrees(1) * 3600e3
# Of a normal variable: the median of its size in standard deviations, and the other way round.
MEDIAN_OF_NORMAL, SIGMA_OF_MEDIAN = 0.6745, 1.4826
ONE_SIGMA = (15.87, 50.0, 84.13)  # percentiles of a normal distribution at -1σ, 0 and +1σ


class Scalable(Protocol):
    """A number, array or tensor."""

    def __mul__(self, factor: float, /) -> Self:
        """Return the product with a number."""


Angle = TypeVar("Angle", bound=Scalable)


def cutoff_per_px(wavelength_m: float, diameter_m: float, pixel_scale_mas: float) -> float:
    """Return D/λ in cycles per pixel of `pixel_scale_mas`: the highest spatial frequency of an image.

    `wavelength_m` is λ, `diameter_m` D, of the pupil or of a subaperture.
    """
    return pixel_scale_mas * MAS * diameter_m / wavelength_m


def resolution_px(wavelength_m: float, diameter_m: float, pixel_scale_mas: float) -> float:
    """Return the resolution element λ/D in pixels, the inverse of `cutoff_per_px`.

    `wavelength_m`, `diameter_m` and `pixel_scale_mas` are as there.
    """
    return MAS_PER_RAD * wavelength_m / diameter_m / pixel_scale_mas


def tilt_nm(angle_mas: Angle, diameter_m: float) -> Angle:
    """Return Noll 2 or 3 [nm RMS] that moves the image by `angle_mas`, for a pupil of `diameter_m`.

    An OPD of θ D/4 RMS moves it by θ.
    """
    return angle_mas * MAS * diameter_m * (1e9 / 4)
