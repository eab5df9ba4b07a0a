"""How good an image is: cuts through its OTF, encircled energy, power spectrum of what a model leaves.

Frequencies are in units of D/λ, beyond which no telescope transfers anything: a structure of that frequency
is λ/D long.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

PADDING = 4  # factor by which a window is padded before its transform: the same curve in more points
PARTS = 5  # into which a pixel is divided along either axis where a circle cuts it
CURVES = {
    "encircled_radius_mas": ("mas", "radius", "radius of circles about the star"),
    "encircled_<image>": ("", "radius", "part of the light within a circle"),
    "otf_x_frequency": ("D/λ", "frequency", "spatial frequency along x"),
    "otf_y_frequency": ("D/λ", "frequency", "spatial frequency along y"),
    "otf_x_<image>": ("", "frequency", "modulus of the OTF along x"),
    "otf_y_<image>": ("", "frequency", "modulus of the OTF along y"),
}


class Curve(NamedTuple):
    """Values over an axis, both (points,)."""

    at: np.ndarray
    value: np.ndarray


def transfer_cut(image: np.ndarray, resolution_px: float, axis: int) -> Curve:
    """Return the modulus of the OTF along an `axis`, 1 for x and 0 for y, over the frequency [D/λ].

    It is the transform of the `image` summed over the other axis, 1 at zero frequency, pixels included: a
    pixel of width p multiplies it by ``sinc(p f)``. It ends at the largest frequency that the pixels sample,
    λ/D being `resolution_px`. Light beyond the window is missing; values that are not finite count as zero,
    and without light all of it is NaN.
    """
    line = np.nan_to_num(np.asarray(image, float)).sum(1 - axis)
    points = PADDING * len(line)
    transform = np.abs(np.fft.rfft(line, points))
    total = line.sum()
    return Curve(
        np.fft.rfftfreq(points) * resolution_px,
        transform / total if total > 0 else np.full(len(transform), np.nan),
    )


def encircled_energy(image: np.ndarray, centre_px: tuple[float, float]) -> Curve:
    """Return the light within circles about `centre_px`, row and column, over their radius [px].

    The radii go in steps of half a pixel to the nearest edge of the window. The light of every pixel of the
    `image` is spread evenly over it; values that are not finite count as zero.
    """
    rows, columns = image.shape
    fine = np.kron(np.nan_to_num(np.asarray(image, float)), np.full((PARTS, PARTS), PARTS**-2.0))
    y, x = (
        (np.arange(size * PARTS) + 0.5) / PARTS - 0.5 - middle
        for size, middle in zip((rows, columns), centre_px, strict=True)
    )
    distance = np.hypot(*np.meshgrid(y, x, indexing="ij")).ravel()
    edge = min(*centre_px, rows - 1 - centre_px[0], columns - 1 - centre_px[1]) + 0.5
    radii = np.arange(0.5, max(edge, 0.5) + 1e-9, 0.5)
    order = np.argsort(distance)
    light = np.concatenate([[0.0], np.cumsum(fine.ravel()[order])])
    return Curve(radii, light[np.searchsorted(distance[order], radii, side="right")])


def power_spectrum(deviations: np.ndarray, resolution_px: float) -> Curve:
    """Return the azimuthal mean of the power of `deviations` over the frequency [D/λ].

    The deviations, (rows, columns), are residuals over their standard errors: of white noise with unit
    variance the power is 1. Their mean and values that are not finite are left out. The curve ends at the
    frequency of the pixels along an axis, λ/D being `resolution_px`.
    """
    used = np.isfinite(deviations)
    power = np.abs(np.fft.fft2(np.where(used, deviations, 0.0))) ** 2 / max(int(used.sum()), 1)
    rows, columns = deviations.shape
    step = 1.0 / min(rows, columns)
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns)[None, :])
    ring = np.rint(frequency / step).astype(int)
    rings = min(rows, columns) // 2
    inside = (ring > 0) & (ring <= rings)
    count = np.bincount(ring[inside], minlength=rings + 1)[1:]
    total, at = (
        np.bincount(ring[inside], one[inside], minlength=rings + 1)[1:] for one in (power, frequency)
    )
    return Curve(at / count * resolution_px, total / count)


def correlations(covariance: np.ndarray) -> np.ndarray:
    """Return the correlation matrix of a `covariance`, (n, n); NaN for what has no variance."""
    sigma = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        return covariance / np.outer(sigma, sigma)


def ring_means(
    image: np.ndarray, centre_px: tuple[float, float], reach_px: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the radii [px] and azimuthal means of rings one pixel wide, (rings,) each.

    The rings lie about `centre_px`, row and column, out to `reach_px`, by default to the edge of the window.
    Values of the `image` that are not finite are left out; a ring without any others is NaN.
    """
    rows, columns = np.indices(image.shape)
    radius = np.hypot(rows - centre_px[0], columns - centre_px[1])
    edge = min(*centre_px, image.shape[0] - 1 - centre_px[0], image.shape[1] - 1 - centre_px[1])
    good = np.isfinite(image) & (radius < (max(edge, 1.0) if reach_px is None else reach_px))
    ring = radius[good].astype(int)
    count = np.bincount(ring)
    with np.errstate(invalid="ignore"):
        return np.bincount(ring, radius[good]) / count, np.bincount(ring, image[good]) / count


def quality_curves(
    images: Mapping[str, np.ndarray],
    centre_px: tuple[float, float],
    resolution_px: float,
    pixel_scale_mas: float,
    *,
    of_window: bool = False,
) -> dict[str, np.ndarray]:
    """Return the `CURVES` of `images` by name, encircled energy about `centre_px`, λ/D being `resolution_px`.

    Light is that of a star of unit flux, or all of the window, `of_window`.
    """
    found: dict[str, np.ndarray] = {}
    for name, image in images.items():
        energy = encircled_energy(image / image.sum() if of_window else image, centre_px)
        found |= {"encircled_radius_mas": energy.at * pixel_scale_mas, f"encircled_{name}": energy.value}
        for axis, letter in ((1, "x"), (0, "y")):
            cut = transfer_cut(image, resolution_px, axis)
            found |= {f"otf_{letter}_frequency": cut.at, f"otf_{letter}_{name}": cut.value}
    return found
