"""Predict a pixel from its neighbours: an image formed by a telescope has no detail finer than lambda/D.

Whatever a well-sampled image shows beyond the prediction is noise or the detector's fault. The
test therefore holds in the core of a bright star as well as in its wings, whatever the wavefront.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

REACH_PX = 3  # neighbours are the other pixels of a (2 * REACH_PX + 1) square
NEAR_PX = 2  # neighbours whose brightness says how bright a pixel could be
NUGGET = 1e-4  # variance over signal squared that the weights allow for: noise, 1 % of unequal response
CUTOFF_MARGIN = 1.1  # room for an error of the pixel scale
MIN_SAMPLING_PX = 2.4  # pixels per lambda/D below which neighbours no longer determine a pixel


@dataclass(frozen=True)
class Prediction:
    """Linear prediction of every pixel of a window from its good neighbours."""

    weights: scipy.sparse.csr_matrix  # (pixels, pixels): row p gives pixel p; columns of bad pixels are 0
    average: scipy.sparse.csr_matrix  # (pixels, pixels): plain mean of the neighbours within `NEAR_PX`
    # (rows, columns): RMS of (pixel - prediction) without noise, over that of the image: detail that the
    # neighbours leave open. It grows where some of them are missing.
    error: np.ndarray
    # (2 * REACH_PX + 1, 2 * REACH_PX + 1): (pixel - prediction) of a pixel with all its neighbours
    kernel: np.ndarray

    @property
    def dependence(self) -> float:
        """Pixels that count as one in a mean of (pixel - prediction)², for they share neighbours."""
        padded = [2 * side for side in self.kernel.shape]  # against wrapping round
        power = np.abs(np.fft.fft2(self.kernel, padded)) ** 2 / np.sum(self.kernel**2)
        return float(np.mean(power**2))  # Parseval: the sum of the squared autocorrelation

    def of(self, images: np.ndarray) -> np.ndarray:
        """Return the predicted images, (..., rows, columns) like `images`."""
        return _apply(self.weights, images)

    def variance(self, pixel_variance: np.ndarray) -> np.ndarray:
        """Return the variance of (pixel - prediction), from `pixel_variance` of independent pixels."""
        squares = scipy.sparse.csr_matrix(
            (self.weights.data**2, self.weights.indices, self.weights.indptr), self.weights.shape
        )
        return pixel_variance + _apply(squares, pixel_variance)

    def local_rms(self, image: np.ndarray) -> np.ndarray:
        """Return the root mean square of the neighbours of every pixel."""
        return np.sqrt(_apply(self.average, image.astype(np.float64) ** 2))


def neighbour_prediction(good: np.ndarray, sampling_px: float) -> Prediction:
    """Return the best linear prediction of each pixel from the `good` pixels (rows, columns) around it.

    The weights solve ``(C + nugget) w = c`` (simple kriging). The covariance of two pixels at distance r is
    the diffraction pattern ``[2 J1(z)/z]^2``, ``z = pi r / sampling``: its spectrum is the telescope's
    transfer function, which ends at D/lambda. `sampling_px` are pixels per lambda/D at the shortest
    wavelength.
    """
    offsets = _neighbour_offsets()
    inside, index = _neighbours(good.shape)
    available = inside & good.ravel()[index]
    # most pixels have all their neighbours; each pattern of those that are missing is solved once
    code = available @ (1 << np.arange(len(offsets), dtype=np.int64))
    _, first, which = np.unique(code, return_index=True, return_inverse=True)
    solved = [_kriging_weights(tuple(available[pixel].tolist()), sampling_px) for pixel in first]
    weights = np.stack([pattern for pattern, _ in solved])[which]
    error = np.array([left for _, left in solved])[which].reshape(good.shape)
    near = available & (np.abs(offsets).max(axis=1) <= NEAR_PX)
    counts = np.maximum(near.sum(axis=1, keepdims=True), 1)
    return Prediction(_sparse(weights, index), _sparse(near / counts, index), error, _kernel(sampling_px))


def _neighbour_offsets() -> np.ndarray:
    reach = range(-REACH_PX, REACH_PX + 1)
    return np.array([(dy, dx) for dy in reach for dx in reach if (dy, dx) != (0, 0)])


@lru_cache(maxsize=16)
def _neighbours(window: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Whether each neighbour of each pixel of a window exists, and its flat index; (pixels, neighbours)."""
    rows, columns = window
    offsets = _neighbour_offsets()
    y = np.arange(rows)[:, None, None] + offsets[:, 0]
    x = np.arange(columns)[None, :, None] + offsets[:, 1]
    y, x = np.broadcast_arrays(y, x)
    inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns)
    index = np.clip(y, 0, rows - 1) * columns + np.clip(x, 0, columns - 1)
    shape = (rows * columns, len(offsets))
    return inside.reshape(shape), index.astype(np.int32).reshape(shape)


@lru_cache(maxsize=10_000)
def _kriging_weights(available: tuple[bool, ...], sampling_px: float) -> tuple[np.ndarray, float]:
    """Weights of the neighbours, 0 for those not available, and the error; patterns recur between frames."""
    weights, mask = np.zeros(len(available)), np.array(available)
    used = _neighbour_offsets()[mask]
    if not len(used):
        return weights, 1.0
    separation = np.hypot(*(used[:, None] - used[None]).transpose(2, 0, 1))
    between = _covariance(separation, sampling_px)
    towards = _covariance(np.hypot(*used.T), sampling_px)
    own = np.linalg.solve(between + NUGGET * np.eye(len(used)), towards)
    weights[mask] = own
    return weights, float(np.sqrt(max(0.0, 1 - 2 * own @ towards + own @ between @ own)))


def _kernel(sampling_px: float) -> np.ndarray:
    weights, _ = _kriging_weights((True,) * len(_neighbour_offsets()), sampling_px)
    side = 2 * REACH_PX + 1
    return np.insert(-weights, len(weights) // 2, 1.0).reshape(side, side)


def _covariance(distance_px: np.ndarray, sampling_px: float) -> np.ndarray:
    z = np.maximum(np.pi * distance_px * CUTOFF_MARGIN / sampling_px, 1e-6)
    return (2 * scipy.special.j1(z) / z) ** 2


def _sparse(values: np.ndarray, index: np.ndarray) -> scipy.sparse.csr_matrix:
    pixels, neighbours = values.shape
    starts = np.arange(0, pixels * neighbours + 1, neighbours, dtype=np.int32)
    return scipy.sparse.csr_matrix((values.ravel(), index.ravel(), starts), shape=(pixels, pixels))


def _apply(matrix: scipy.sparse.csr_matrix, images: np.ndarray) -> np.ndarray:
    flat = images.reshape(-1, matrix.shape[1])
    return (matrix @ flat.T).T.reshape(images.shape)
