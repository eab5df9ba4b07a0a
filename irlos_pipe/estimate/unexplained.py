"""What an image has that the model of the loop has not: motion, halo, and structure that neither explains.

Right exposures differ from the model by image motion within them and by the AO residual of the moment, which
moves light from the core into the halo and makes speckles. Motion and halo have known shapes: second
differences of the model image, and the model image blurred. What remains besides is small in right
exposures, in whatever seeing, and not where the optics or the detector are others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

HALO_PX = 4.0  # sigma of the Gaussian over which the light of the core is spread to stand for the halo
FOCUS, ALONG_X, ALONG_Y, ACROSS, HALO = 2, 5, 6, 7, 8  # rows of the shapes


class Residual(NamedTuple):
    """What is left of an image by the model, and then by motion and halo as well; 0 in bad pixels."""

    whole_e: np.ndarray  # (pixels,), by the model
    rest_e: np.ndarray  # (pixels,), by motion and halo as well
    star_e: np.ndarray  # (pixels,), light of the star by the model
    variance_e2: np.ndarray  # (pixels,), of the noise
    factor: float  # variance of the photons' noise over their number

    @property
    def level(self) -> float:
        """Variance of a pixel without light, over the light [e-]."""
        return float(np.min(self.variance_e2) / max(self.star_e.sum(), 1e-300))

    def structure(self, level: float) -> Structure:
        """Return how much light the model does not explain, with weights that are best at a `level` of noise.

        Speckles that lie on the star's light have a variance of that times the light of the halo. So squares
        are summed with ``w = (I / V)²``, which sees them best, and divided by ``Σ w I · Σ I``: for speckles
        the result depends neither on how wide the image is nor on how bright.
        """
        flux_e = self.star_e.sum()
        weight = (self.star_e / (self.factor * self.star_e + level * flux_e)) ** 2
        light = max(float(weight @ self.star_e * flux_e), 1e-300)
        noise = float(weight @ self.variance_e2)
        error = math.sqrt(2.0 * float(weight**2 @ self.variance_e2**2))
        rest, whole = (float(weight @ one**2) - noise for one in (self.rest_e, self.whole_e))
        star = float(weight @ self.star_e**2)
        return Structure(*(one / light for one in (rest, whole, star, error)))


class Structure(NamedTuple):
    """Mean squares beyond noise: of the rest, of the whole, and of the star itself; and their error."""

    rest: float
    whole: float
    star: float
    sigma: float


@dataclass(frozen=True)
class Unexplained:
    """What the model does not explain in one image."""

    # half the variance of the image motion beyond the model's, along the axis where it differs most
    blur_px2: float
    blur_sigma_px2: float
    halo: float  # part of the light that is in the halo, and in the core by the model
    halo_sigma: float
    shift_nm: float  # change of the defocus if motion and halo are free
    shift_sigma_nm: float  # how much of it noise makes
    rest: Residual = field(compare=False, repr=False)


def unexplained(
    residual_e: np.ndarray,
    star_e: np.ndarray,
    slopes_e: np.ndarray,
    good: np.ndarray,
    factor: float,
    floor_e2: float,
) -> Unexplained:
    """Take the residual of a fit apart.

    Image minus model, `residual_e`, and the light of the star in the model, `star_e`, are (rows, columns)
    [e-], as the `good` pixels; `slopes_e` (3, rows · columns) are the derivatives by tip, tilt and focus
    [e-/nm]. For `factor` and `floor_e2` see `Noise`.
    """
    pixels = star_e.size
    shapes = np.empty((9, pixels))
    shapes[:3] = slopes_e
    shapes[3], shapes[4] = star_e.ravel(), 1.0
    shapes[5:8] = _second_differences(star_e).reshape(3, pixels)
    shapes[8] = gaussian_filter(star_e, HALO_PX, truncate=3.0, mode="constant").ravel()
    light_e = np.maximum(star_e.ravel(), 0.0)
    variance = factor * light_e + floor_e2
    weighted = shapes * (good.ravel() / variance)
    normal = weighted @ shapes.T
    scale = 1 / np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    normal *= scale * scale[:, None]
    normal.flat[::10] += 1e-9
    covariance = np.linalg.inv(normal) * scale * scale[:, None]
    found = covariance @ (weighted @ residual_e.ravel())
    fitted = np.linalg.inv(normal[:5, :5])[FOCUS, FOCUS] * scale[FOCUS] ** 2
    residual_e = residual_e.ravel()
    rest_e = residual_e - found @ shapes
    blur_px2, blur_sigma_px2 = _largest(found, covariance)
    seen = good.ravel()
    return Unexplained(
        blur_px2,
        blur_sigma_px2,
        float(found[HALO]),
        math.sqrt(covariance[HALO, HALO]),
        float(found[FOCUS]),
        math.sqrt(max(float(covariance[FOCUS, FOCUS] - fitted), 0.0)),
        Residual(residual_e * seen, rest_e * seen, light_e * seen, variance, factor),
    )


def _largest(found: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Eigenvalue of the motion's tensor that is the largest either way, and its error."""
    tensor = [[found[ALONG_X], found[ACROSS] / 2], [found[ACROSS] / 2, found[ALONG_Y]]]
    values, axes = np.linalg.eigh(tensor)
    index = int(np.abs(values).argmax())
    x, y = axes[:, index]
    by = np.zeros(len(found))
    by[[ALONG_X, ALONG_Y, ACROSS]] = x * x, y * y, x * y
    return float(values[index]), math.sqrt(max(float(by @ covariance @ by), 0.0))


def _second_differences(image: np.ndarray) -> np.ndarray:
    """By x twice, y twice, and by both, (3, rows, columns)."""
    wide = np.pad(image, 1)
    x = wide[1:-1, 2:] + wide[1:-1, :-2] - 2 * image
    y = wide[2:, 1:-1] + wide[:-2, 1:-1] - 2 * image
    xy = (wide[2:, 2:] + wide[:-2, :-2] - wide[2:, :-2] - wide[:-2, 2:]) / 4
    return np.stack([x, y, xy])
