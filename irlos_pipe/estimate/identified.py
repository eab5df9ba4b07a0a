"""Which modes a mean image determines, beside the prior: eigenvalues of its Fisher matrix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.numerics.levenberg_marquardt import scaled_inverse


@dataclass(frozen=True)
class Identified:
    """What the data say of modes beside a prior.

    Attributes
    ----------
    nolls : tuple of int
    information : ndarray, (modes,)
        Eigenvalues of the Fisher matrix in units of the prior, descending: above 1, the data say more of a
        combination of modes than the prior.
    left : ndarray, (modes,)
        Standard error of every mode over that of its prior.
    bound_nm : ndarray, (modes,)
        Cramér–Rao bound without a prior of the modes [nm].
    """

    nolls: tuple[int, ...]
    information: np.ndarray
    left: np.ndarray
    bound_nm: np.ndarray

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

    Flux, background and the free parameters of the effects, with their priors, are marginalised.

    Parameters
    ----------
    model : ImageModel
    modes_nm : mapping of int to float
        The wavefront, Noll: nm RMS; modes that are left out are 0.
    values : tensor, (effect parameters,)
    frames : Frames
    prior_sigma_nm : ndarray, (modes,)
        Standard deviation of the prior of every mode.
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
