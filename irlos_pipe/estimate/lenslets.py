"""Low orders from four images: by their centroids, as a 2x2 Shack–Hartmann sensor does, or by a fit of them.

The centre of light of a lenslet's image lies where the mean slope of the wavefront over it points, whatever
else the wavefront does (the intensity-weighted mean of a transform's coordinate is the mean gradient of the
phase), as long as the window holds all the light. It does not, and read noise forbids to sum it all: pixels
below a threshold are left out, at the price of a gain that is not quite one.

Eigenvalues of the Fisher matrix say which modes a mean image determines better than the prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.units import MAS, NM
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.numerics.solver import scaled_inverse

NOLLS = (2, 3, 4, 5, 6)
SIDES = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])  # (x, y): lower left and right, upper left and right
THRESHOLD_SIGMA, THRESHOLD_PEAK = 3.0, 0.05  # of the noise of a pixel, and of the brightest pixel


def gradient_matrix(geometry: PupilGeometry, nolls: Sequence[int] = NOLLS) -> np.ndarray:
    """Return the displacement of the four images per nm RMS of each mode, (8, modes) [mas/nm].

    Rows are x and y of every lenslet: the mean slopes over a quarter of an annulus from r to R, whose mean x
    and y are ``4 (R³ - r³) / 3π (R² - r²)``; vanes are left out. The `geometry` gives diameter and central
    hole, `nolls` are from 2 to 6.
    """
    outer, inner = geometry.diameter_m / 2, geometry.obscuration_m / 2
    middle = 4 * (outer**3 - inner**3) / (3 * np.pi * (outer**2 - inner**2)) / outer
    x, y = middle * SIDES.T
    one, none = np.ones(len(SIDES)), np.zeros(len(SIDES))
    slopes = {  # of the modes in units of the radius
        2: (2 * one, none),
        3: (none, 2 * one),
        4: (4 * np.sqrt(3) * x, 4 * np.sqrt(3) * y),
        5: (2 * np.sqrt(6) * y, 2 * np.sqrt(6) * x),
        6: (2 * np.sqrt(6) * x, -2 * np.sqrt(6) * y),
    }
    columns = [np.stack(slopes[noll], axis=1).ravel() for noll in nolls]
    return np.stack(columns, axis=1) / outer * NM / MAS


def centroids_mas(images_e: np.ndarray, pixel_scale_mas: float, noise_e: float) -> np.ndarray:
    """Return the centres of light of the four images, (frames, 4, 2) as (x, y) from the window's centre.

    The images lie side by side in `images_e` (frames, 2 rows, 2 columns); a dark pixel has a noise of
    `noise_e`.
    """
    frames, rows, columns = len(images_e), images_e.shape[1] // 2, images_e.shape[2] // 2
    apart = images_e.astype(float).reshape(frames, 2, rows, 2, columns)
    apart = apart.transpose(0, 1, 3, 2, 4).reshape(frames, 4, rows, columns)
    peak = apart.max(axis=(2, 3), keepdims=True)
    bright = np.maximum(apart - np.maximum(THRESHOLD_SIGMA * noise_e, THRESHOLD_PEAK * peak), 0)
    light = np.maximum(bright.sum(axis=(2, 3)), 1e-300)
    x = (bright.sum(axis=2) @ (np.arange(columns) - (columns - 1) / 2)) / light
    y = (bright.sum(axis=3) @ (np.arange(rows) - (rows - 1) / 2)) / light
    return np.stack([x, y], axis=2) * pixel_scale_mas


def modes_of_centroids_nm(
    images_e: np.ndarray,
    geometry: PupilGeometry,
    pixel_scale_mas: float,
    noise_e: float,
    nolls: Sequence[int] = NOLLS,
) -> np.ndarray:
    """Return the modes that move the four images most nearly as they are, (frames, modes) [nm RMS].

    `images_e`, `pixel_scale_mas` and `noise_e` are as of `centroids_mas`, `geometry` and `nolls` as of
    `gradient_matrix`.
    """
    displaced = centroids_mas(images_e, pixel_scale_mas, noise_e).reshape(len(images_e), -1)
    return displaced @ np.linalg.pinv(gradient_matrix(geometry, nolls)).T


@dataclass(frozen=True)
class Identified:
    """What the data say of modes in comparison with a prior."""

    nolls: tuple[int, ...]
    # (modes,), eigenvalues of the Fisher matrix in units of the prior, descending: above 1, the data say more
    # of a combination of modes than the prior
    information: np.ndarray
    left: np.ndarray  # (modes,), standard error of every mode over that of its prior
    bound_nm: np.ndarray  # (modes,), Cramér–Rao bound without a prior of the modes

    @property
    def combinations(self) -> int:
        """Number of combinations of modes of which the data say more than the prior."""
        return int(np.sum(self.information > 1))

    def determined(self, share: float = 0.5) -> tuple[int, ...]:
        """Modes whose error is at most this `share` of the prior's."""
        return tuple(noll for noll, left in zip(self.nolls, self.left, strict=True) if left <= share)


def identified(
    model: ImageModel,
    modes_nm: Mapping[int, float],
    values: torch.Tensor,
    frames: Frames,
    prior_sigma_nm: np.ndarray,
) -> Identified:
    """Return what the mean of `frames` says of the modes of a `model`, photon and read noise alone.

    Flux, background and the free parameters of the effects, with their priors, are marginalised. The
    wavefront is `modes_nm`, Noll: nm RMS, modes that are left out are 0; effect parameters are at `values`
    (effect parameters,); every mode has a prior of `prior_sigma_nm` (modes,).
    """
    nolls = model.psf.nolls
    wavefront = torch.tensor([[modes_nm.get(noll, 0.0) for noll in nolls]], dtype=torch.float64)
    nothing = torch.zeros(1, dtype=torch.float64)
    image, columns = model.predict_and_jacobian(wavefront, frames.flux_e.mean()[None], nothing, values)
    variance_e2 = frames.noise.mean_variance_e2(image[0], len(frames.images_e))
    root = torch.where(frames.good, variance_e2, torch.inf).rsqrt()
    whitened = (columns[0].double() * root).flatten(1)
    fisher = (whitened @ whitened.mT).numpy()
    size = len(nolls)
    precision = [p.prior_sigma**-2 for p in model.effects.parameters]
    fisher[range(size, len(fisher) - 2), range(size, len(fisher) - 2)] += precision
    cross = fisher[:size, size:]
    own = fisher[:size, :size] - cross @ np.linalg.pinv(fisher[size:, size:], hermitian=True) @ cross.T
    relative = own * prior_sigma_nm[:, None] * prior_sigma_nm[None, :]
    bound = scaled_inverse(torch.as_tensor(own)[None])[0].numpy()
    return Identified(
        nolls,
        np.linalg.eigvalsh(relative)[::-1].clip(min=0),
        np.sqrt(np.diag(np.linalg.inv(relative + np.eye(size)))),
        np.sqrt(np.diag(bound).clip(min=0)),
    )
