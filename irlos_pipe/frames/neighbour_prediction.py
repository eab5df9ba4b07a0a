"""Predict a pixel from its neighbours: an image formed by a telescope has no detail finer than lambda/D.

Whatever a well-sampled image shows beyond the prediction is noise or the detector's fault. The
test therefore holds in the core of a bright star as well as in its wings, whatever the wavefront.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import j1

REACH_PX = 2  # neighbours are the other pixels of a (2 * REACH_PX + 1) square
NUGGET = 1e-5  # white noise over signal in the prediction's weights; keeps them finite
CUTOFF_MARGIN = 1.1  # room for an error of the pixel scale
MIN_SAMPLING_PX = 2.4  # pixels per lambda/D below which neighbours no longer determine a pixel


@dataclass(frozen=True)
class Prediction:
    """Linear prediction of every pixel of a window from its good neighbours.

    Attributes
    ----------
    weights : sparse matrix, (pixels, pixels)
        Row p gives pixel p from the others; bad pixels have empty columns.
    average : sparse matrix, (pixels, pixels)
        Plain mean of the same neighbours.
    """

    weights: csr_matrix
    average: csr_matrix

    def of(self, images: np.ndarray) -> np.ndarray:
        """Return the predicted images, (..., rows, columns) like `images`."""
        return _apply(self.weights, images)

    def variance(self, pixel_variance: np.ndarray) -> np.ndarray:
        """Return the variance of (pixel - prediction), from `pixel_variance` of independent pixels."""
        return pixel_variance + _apply(self.weights.multiply(self.weights).tocsr(), pixel_variance)

    def local_rms(self, image: np.ndarray) -> np.ndarray:
        """Return the root mean square of the neighbours of every pixel."""
        return np.sqrt(_apply(self.average, image.astype(np.float64) ** 2))


def is_well_sampled(sampling_px: float) -> bool:
    """Return whether images with `sampling_px` pixels per lambda/D determine a pixel by its neighbours."""
    return sampling_px >= MIN_SAMPLING_PX


def neighbour_prediction(good: np.ndarray, sampling_px: float) -> Prediction:
    """Return the best linear prediction of each pixel from the good pixels around it.

    The weights solve ``(C + nugget) w = c`` (simple kriging). The covariance of two pixels at
    distance r is the diffraction pattern ``[2 J1(z)/z]^2``, ``z = pi r / sampling``: its spectrum
    is the telescope's transfer function, which ends at D/lambda.

    Parameters
    ----------
    good : ndarray of bool, (rows, columns)
        Pixels to predict from.
    sampling_px : float
        Pixels per lambda/D at the shortest wavelength.
    """
    offsets = _neighbour_offsets()
    available, index = _neighbours(good, offsets)
    # most pixels have all their neighbours; each pattern of those that are missing is solved once
    code = available @ (1 << np.arange(len(offsets)))
    _, first, which = np.unique(code, return_index=True, return_inverse=True)
    solved = [_kriging_weights(offsets, available[pixel], sampling_px) for pixel in first]
    weights = np.stack(solved)[which]
    counts = np.maximum(available.sum(axis=1, keepdims=True), 1)
    return Prediction(_sparse(weights, index), _sparse(available / counts, index))


def _neighbour_offsets() -> np.ndarray:
    reach = range(-REACH_PX, REACH_PX + 1)
    return np.array([(dy, dx) for dy in reach for dx in reach if (dy, dx) != (0, 0)])


def _neighbours(good: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether each neighbour of each pixel exists and is good, and its flat index; (pixels, neighbours)."""
    rows, columns = good.shape
    y = np.arange(rows)[:, None, None] + offsets[:, 0]
    x = np.arange(columns)[None, :, None] + offsets[:, 1]
    y, x = np.broadcast_arrays(y, x)
    inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns)
    y, x = np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)
    shape = (good.size, len(offsets))
    return (inside & good[y, x]).reshape(shape), (y * columns + x).reshape(shape)


def _kriging_weights(offsets: np.ndarray, available: np.ndarray, sampling_px: float) -> np.ndarray:
    weights = np.zeros(len(offsets))
    used = offsets[available]
    if len(used):
        separation = np.hypot(*(used[:, None] - used[None]).transpose(2, 0, 1))
        matrix = _covariance(separation, sampling_px) + NUGGET * np.eye(len(used))
        weights[available] = np.linalg.solve(matrix, _covariance(np.hypot(*used.T), sampling_px))
    return weights


def _covariance(distance_px: np.ndarray, sampling_px: float) -> np.ndarray:
    z = np.maximum(np.pi * distance_px * CUTOFF_MARGIN / sampling_px, 1e-6)
    return (2 * j1(z) / z) ** 2


def _sparse(values: np.ndarray, index: np.ndarray) -> csr_matrix:
    pixels, neighbours = values.shape
    starts = np.arange(0, pixels * neighbours + 1, neighbours)
    matrix = csr_matrix((values.ravel(), index.ravel(), starts), shape=(pixels, pixels))
    matrix.eliminate_zeros()
    return matrix


def _apply(matrix: csr_matrix, images: np.ndarray) -> np.ndarray:
    flat = images.reshape(-1, matrix.shape[1])
    return (matrix @ flat.T).T.reshape(images.shape)
