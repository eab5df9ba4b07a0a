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
    wide = ImageModel(
        light_path(general.psf.settings, own, device=general.psf.device), general.effects.effects
    )
    known = [own.index(noll) for noll in nolls]
    slopes = [defocus_slopes(general, wide, result, int(frame), good, noise)[known] for frame in chosen]
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
    model: ImageModel,
    wide: ImageModel,
    result: LiftResult,
    frame: int,
    good: torch.Tensor,
    noise: NoiseModel,
) -> np.ndarray:
    """Return by how much one frame's estimate of defocus errs per error of each known mode, (modes,).

    ``(JᵀWJ)⁻¹ JᵀW`` is one factor per pixel for the defocus; K is applied to it backwards, so that its
    many columns are never computed.

    Parameters
    ----------
    model : ImageModel
        With the modes that LIFT fits.
    wide : ImageModel
        The same with the known modes as parameters.
    result : LiftResult
    frame : int
    good : tensor of bool, (rows, columns)
    noise : NoiseModel
    """
    fitted_nm, values = result.zernike_nm[frame : frame + 1].double(), result.solution.values[frame, -2:]
    flux_e, background_e = values[:, None]
    image, columns = model.predict_and_jacobian(fitted_nm, flux_e, background_e)
    weight = torch.where(good, 1 / noise.variance_e2(image[0].double().cpu()), 0.0).flatten()
    free = columns[0].double().flatten(1).cpu()
    inverse = scaled_inverse(((free * weight) @ free.mT)[None])[0]
    factors = inverse[result.nolls.index(DEFOCUS)] @ (free * weight)
    modes_nm = torch.zeros(1, len(wide.psf.nolls), dtype=torch.float64)
    modes_nm[:, [wide.psf.nolls.index(noll) for noll in result.nolls]] = fitted_nm
    with torch.enable_grad():
        modes_nm.requires_grad_()
        seen = wide.predict(modes_nm, flux_e, background_e).flatten().cpu() @ factors
    (slopes,) = torch.autograd.grad(seen, modes_nm)
    return slopes[0].numpy()
