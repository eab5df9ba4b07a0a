"""How good an image is: cuts through its OTF, encircled energy, power spectrum of what a model leaves.

Frequencies are in units of D/λ, beyond which no telescope transfers anything: a structure of that frequency
is λ/D long.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

PADDING = 4  # of a window before its transform, which draws the same curve through more points
PARTS = 5  # into which a pixel is divided along either axis where a circle cuts it


class Curve(NamedTuple):
    """Values over an axis, both (points,)."""

    at: np.ndarray
    value: np.ndarray


def transfer_cut(image: np.ndarray, resolution_px: float, axis: int) -> Curve:
    """Return the modulus of the OTF along one axis, 1 at zero frequency.

    It is the transform of the image summed over the other axis, pixels included: a pixel of width p
    multiplies it by ``sinc(p f)``. Light beyond the window is missing.

    Parameters
    ----------
    image : ndarray, (rows, columns)
        Values that are not finite count as zero.
    resolution_px : float
        λ/D [px].
    axis : int
        1 along x, 0 along y.

    Returns
    -------
    Curve
        Over the frequency [D/λ], up to the largest that the pixels sample; NaN of an image without light.
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
    """Return the light within circles about a centre, in the unit of the image.

    Parameters
    ----------
    image : ndarray, (rows, columns)
        Light of pixels, spread evenly over each of them; values that are not finite count as zero.
    centre_px : (float, float)
        Row and column.

    Returns
    -------
    Curve
        Over the radius [px], in steps of half a pixel to the nearest edge of the window.
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
    """Return the azimuthal mean of the power of `deviations`, which is 1 for white noise of unit variance.

    Parameters
    ----------
    deviations : ndarray, (rows, columns)
        Residual over its standard error; values that are not finite are left out.
    resolution_px : float
        λ/D [px].

    Returns
    -------
    Curve
        Over the frequency [D/λ], the mean of the image left out; up to that of the pixels along an axis.
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
