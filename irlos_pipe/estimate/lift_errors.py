"""How far LIFT's errors can be believed: the scatter at one offset, the misfit, the error of the optics.

Frames at one offset show the same wavefront but for the AO residual, which differs from frame to frame. The
scatter of their estimates is therefore what LIFT's errors should be, and what differs between their
residuals is what χ²/ν would be if the model were right: a misfit is what the residuals have in common.

All frames share the error of LIFT's defocus by that of the NCPAs which it takes for known: an error
δ of the known wavefront moves the estimates by ``-(JᵀWJ)⁻¹ JᵀW K δ``: J are the
derivatives of the image by what LIFT fits, K those by the known modes, W the weights of the pixels.
Not the error of the known defocus alone counts, but that of every mode whose image resembles that of defocus.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import LiftResult
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.solver import scaled_inverse
from irlos_pipe.optics.lenslets import light_path

LEAST_FREEDOM = 5  # degrees of freedom from which scatter within offsets is preferred to that about the line


@dataclass(frozen=True)
class FrameErrors:
    """Errors of single frames of a ramp beyond photon noise."""

    # by which errors differ from frame to frame beyond photon noise, see `instant_error_nm`
    instant_nm: float
    chi2_nu: float  # median of the frames
    nominal_chi2_nu: float  # what it would be about a right model; NaN where no offset has two frames

    @property
    def excess(self) -> float:
        """By how much χ²/ν exceeds its nominal value; all of it where that is not known."""
        nominal = self.nominal_chi2_nu if np.isfinite(self.nominal_chi2_nu) else 0.0
        return max(0.0, self.chi2_nu - nominal)

    @property
    def growth(self) -> float:
        """Factor on errors of photon noise by what the model misfits, at least 1."""
        ratio = self.chi2_nu / self.nominal_chi2_nu
        return float(np.sqrt(max(1.0, ratio))) if np.isfinite(ratio) else 1.0

    def sigma_nm(self, photon_nm: np.ndarray, calibration_nm: float | np.ndarray = 0.0) -> np.ndarray:
        """Return the standard errors of estimates [nm].

        Those by photon and read-out noise alone are `photon_nm`; all frames share the errors of the NCPAs,
        and by these `calibration_nm`, see `optics_sigma_nm`.
        """
        return np.sqrt((self.growth * photon_nm) ** 2 + self.instant_nm**2 + calibration_nm**2)


def excess_scatter_nm(introduced_nm: np.ndarray, estimated_nm: np.ndarray, photon_nm: np.ndarray) -> float:
    """Return the standard deviation of a ramp's estimates at one offset beyond photon noise.

    With too few frames per offset, that about the straight line. The arguments have the shape (frames,);
    failed estimates are NaN, and `photon_nm` are errors by photon noise.
    """
    good = np.isfinite(estimated_nm) & np.isfinite(photon_nm)
    introduced, estimated = introduced_nm[good], estimated_nm[good]
    groups = [estimated[introduced == value] for value in np.unique(introduced)]
    freedom = len(estimated) - len(groups)
    square = sum(float(np.sum((group - group.mean()) ** 2)) for group in groups)
    if freedom < LEAST_FREEDOM:
        residual = estimated - np.polyval(np.polyfit(introduced, estimated, 1), introduced)
        freedom, square = max(len(estimated) - 2, 1), float(np.sum(residual**2))
    return float(np.sqrt(max(0.0, square / freedom - float(np.median(photon_nm[good] ** 2)))))


def instant_error_nm(introduced_nm: np.ndarray, estimated_nm: np.ndarray, photon_nm: np.ndarray) -> float:
    """Return by how much errors of single frames differ beyond photon noise [nm RMS].

    Standard deviation of estimated minus introduced defocus: the AO residual's own defocus, and what a
    residual of another strength than the calibrated one makes of the defocus while it lasts. The scatter at
    one offset knows only what changes faster than the focus stage moves. Arguments as of `excess_scatter_nm`.
    """
    good = np.isfinite(estimated_nm) & np.isfinite(photon_nm)
    error = (estimated_nm - introduced_nm)[good]
    if len(error) < 2:
        return 0.0
    return float(np.sqrt(max(0.0, error.var(ddof=1) - float(np.median(photon_nm[good] ** 2)))))


def nominal_frame_chi2(
    images_e: torch.Tensor,
    model_e: torch.Tensor,
    good: torch.Tensor,
    noise: NoiseModel,
    introduced_nm: np.ndarray,
    parameters: int,
) -> float:
    """Return the mean χ²/ν of frames about a right model, from what differs between frames at one offset.

    So many `parameters` were fitted to each of the images (frames, rows, columns) on their `good` pixels
    (rows, columns) at `introduced_nm` (frames,). NaN where no offset has two frames.
    """
    freedom = max(int(good.sum()) - parameters, 1)
    total, count = 0.0, 0
    for value in np.unique(introduced_nm):
        own = torch.as_tensor(np.flatnonzero(introduced_nm == value))
        if len(own) < 2:
            continue
        model = model_e[own].double()
        residual = (images_e[own].double() - model) * noise.variance_e2(model) ** -0.5
        deviation = (residual - residual.mean(0))[:, good]
        total += float(deviation.square().sum())
        count += len(own) - 1
    return total / count / freedom if count else float("nan")


MOST_OFFSETS = 5  # offsets at which it is computed, at most; between them it is interpolated


def optics_sigma_nm(
    model: ImageModel,
    result: LiftResult,
    good: torch.Tensor,
    noise: NoiseModel,
    nolls: Sequence[int],
    covariance_nm2: np.ndarray,
) -> np.ndarray:
    """Return the standard error of every frame's defocus by that of the known wavefront, (frames,) [nm].

    The `model` of the frames has no free effect parameters, `result` is their fit on the `good` pixels (rows,
    columns). The modes `nolls` of the known wavefront have errors of `covariance_nm2` (modes, modes).
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

    Failed estimates of `defocus_nm` (frames,) are NaN.
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

    ``(JᵀWJ)⁻¹ JᵀW`` is one factor per pixel for the defocus; K is applied to it backwards, so that its many
    columns are never computed. The `model` has the modes that LIFT fits, the `wide` one the known modes as
    parameters too; `good` pixels are (rows, columns).
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
