"""Images of pupils made of polygons, by analysis: their Fourier transforms are sums over sides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

MAS_RAD = np.deg2rad(1 / 3.6e6)
NODES = 6  # per pixel and axis


def hexagon(flat_to_flat_m: float, centre_m: Sequence[float]) -> np.ndarray:
    """Corners of a hexagon with a side at the top, (6, 2) [m]."""
    angles = np.deg2rad(np.arange(6) * 60.0)
    return centre_m + flat_to_flat_m / np.sqrt(3) * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def area_m2(corners_m: np.ndarray) -> float:
    x, y = corners_m.T
    return abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2


def polygon_image(polygons_m, wavelength_nm: float, window: int, pixel_scale_mas: float, opd_nm=None):
    """Pixel-integrated image, as a fraction of the light through all polygons; one OPD [nm] each."""
    pixel = pixel_scale_mas * MAS_RAD / (wavelength_nm * 1e-9)
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    f = (((np.arange(window) - (window - 1) / 2)[:, None] + nodes / 2) * pixel).ravel()
    phases = np.exp(2j * np.pi * np.broadcast_to(opd_nm or 0.0, len(polygons_m)) / wavelength_nm)
    field = sum(
        phase * _transform(p, f[None, :], f[:, None]) for p, phase in zip(polygons_m, phases, strict=True)
    )
    fine = (np.abs(field) ** 2).reshape(window, NODES, window, NODES)
    total = np.einsum("yjxi,j,i->yx", fine, weights / 2, weights / 2) * pixel**2
    return total / sum(area_m2(p) for p in polygons_m)


def _transform(corners_m: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """``∫ exp(-2πi f·u) du`` over a polygon, by the divergence theorem."""
    found = np.zeros(np.broadcast_shapes(fx.shape, fy.shape), dtype=complex)
    for start, end in zip(corners_m, np.roll(corners_m, -1, axis=0), strict=True):
        (dx, dy), (x, y) = end - start, (start + end) / 2
        found += (fx * dy - fy * dx) * np.sinc(fx * dx + fy * dy) * np.exp(-2j * np.pi * (fx * x + fy * y))
    return found * 1j / (2 * np.pi * (fx**2 + fy**2))
