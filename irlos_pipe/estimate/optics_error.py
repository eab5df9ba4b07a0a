"""Error of LIFT's defocus by that of the NCPAs which it takes for known: the error of the optics.

All frames share it. An error δ of the known wavefront moves the estimates by ``-(JᵀWJ)⁻¹ JᵀW K δ``: J are the
derivatives of the image by what LIFT fits, K those by the known modes, W the weights of the pixels.
Not the error of the known defocus alone counts, but that of every mode whose image resembles that of defocus.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import LiftResult
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.levenberg_marquardt import scaled_inverse
from irlos_pipe.optics.lenslets import light_path

MOST_OFFSETS = 5  # at which it is computed; between them it is interpolated


def optics_sigma_nm(
    model: ImageModel,
    result: LiftResult,
    good: torch.Tensor,
    noise: NoiseModel,
    nolls: Sequence[int],
    covariance_nm2: np.ndarray,
) -> np.ndarray:
    """Return the standard error of every frame's defocus by that of the known wavefront, (frames,) [nm].

    Parameters
    ----------
    model : ImageModel
        Of the frames, without free effect parameters.
    result : LiftResult
        Of the frames.
    good : tensor of bool, (rows, columns)
    noise : NoiseModel
    nolls : sequence of int
        Modes of the known wavefront.
    covariance_nm2 : ndarray, (modes, modes)
        Of their errors.
    """
    defocus_nm = result.mode(DEFOCUS)[0].numpy()
    chosen = spread_over(defocus_nm)
    if not len(chosen):
        return np.full(len(defocus_nm), np.nan)
    general, own = model.general, tuple(sorted({*nolls, *result.nolls}))
    wide = ImageModel(light_path(general.psf.settings, own, rough_derivatives=True), general.effects.effects)
    known = [own.index(noll) for noll in nolls]
    slopes = [defocus_slopes(wide, result, int(frame), good, noise)[known] for frame in chosen]
    sigma_nm = [float(np.sqrt(slope @ covariance_nm2 @ slope)) for slope in slopes]
    return np.interp(defocus_nm, defocus_nm[chosen], sigma_nm)


def spread_over(defocus_nm: np.ndarray) -> np.ndarray:
    """Return the frames at which the error is computed, in order of their defocus, (offsets,).

    Parameters
    ----------
    defocus_nm : ndarray, (frames,)
        Estimates; NaN where they failed.
    """
    usable = np.flatnonzero(np.isfinite(defocus_nm))
    if not len(usable):
        return usable
    order = usable[np.argsort(defocus_nm[usable], kind="stable")]
    return order[np.unique(np.linspace(0, len(order) - 1, MOST_OFFSETS).round().astype(int))]


def defocus_slopes(
    wide: ImageModel, result: LiftResult, frame: int, good: torch.Tensor, noise: NoiseModel
) -> np.ndarray:
    """Return by how much one frame's estimate of defocus errs per error of each known mode, (modes,).

    Parameters
    ----------
    wide : ImageModel
        With the known modes as parameters.
    result : LiftResult
    frame : int
    good : tensor of bool, (rows, columns)
    noise : NoiseModel
    """
    values, own = result.solution.values[frame : frame + 1], wide.psf.nolls
    modes_nm = torch.zeros(1, len(own), dtype=torch.float64)
    fitted = [own.index(noll) for noll in result.nolls]
    modes_nm[:, fitted] = result.zernike_nm[frame].double()
    image, columns = wide.predict_and_jacobian(modes_nm, values[:, -2], values[:, -1])
    weight = torch.where(good, 1 / noise.variance_e2(image[0].double()), 0.0).flatten()
    known = columns[0].double().flatten(1).cpu()
    free = torch.cat([known[fitted], known[-2:]])
    fisher = (free * weight) @ free.mT
    response = scaled_inverse(fisher[None])[0] @ ((free * weight) @ known[: len(own)].mT)
    return response[result.nolls.index(DEFOCUS)].numpy()
