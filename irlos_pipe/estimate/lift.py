"""LIFT: tip, tilt, defocus (and more) of single images, by iterated maximum likelihood or MAP.

Every image has its own flux and background. The noise covariance is diagonal; its variances
come from the image itself, from the model of a first fit, or follow the model all the way
(`iterative`), which is what makes the estimate unbiased at low flux.

Reference: Meimon, Fusco & Mugnier 2010, Opt. Lett. 35, 3036; the MAP step here has the prior
precision on the diagonal only and the ``-C⁻¹(a - ā)`` term that the published code lacks.

Noise realisations of a frame are near its wavefront. On the way to their own a coarse model will
do, with what it lacks near the frame to first order: it leaves some hundredths of a standard error to
the exact model, whose gradients take a step or two with the curvature of the other.

Frames at one offset show the same wavefront but for the AO residual, which differs from frame to frame. The
scatter of their estimates is therefore what LIFT's errors should be, and what differs between their
residuals is what χ²/ν would be if the model were right: a misfit is what the residuals have in common.

All frames share the error of LIFT's defocus by that of the NCPAs which it takes for known: an error
δ of the known wavefront moves the estimates by ``-(JᵀWJ)⁻¹ JᵀW K δ``: J are the
derivatives of the image by what LIFT fits, K those by the known modes, W the weights of the pixels.
Not the error of the known defocus alone counts, but that of every mode whose image resembles that of defocus.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.image_fit import ImageFit, Layout, masked_variance
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.parallel import at_once, process_map
from irlos_pipe.numerics.solver import CheapGradientProblem, Solution, joined, mixed, scaled_inverse, solve
from irlos_pipe.optics.lenslets import light_path
from irlos_pipe.optics.psf import PsfModel

DEFAULTS = LiftOptions()
ROUGH_TOLERANCE = 10.0  # fall of χ² (3 σ) that does not matter while only the variances are sought
IMAGES_AT_ONCE = 128  # images in a piece: a dozen copies of them are made on the way
NEAR_AT_ONCE = 32  # of those that have a quicker model, which take long: some for every worker
CLOSE_TOLERANCE = 1e-2  # of a fit that a coarse model began: the step that ends it leaves a tenth of that
COARSE_TOLERANCE = 1000.0  # fall of χ² (30 σ): near enough to go on with variances that follow the model


@dataclass(frozen=True)
class LiftResult:
    """Estimates of a batch of images."""

    nolls: tuple[int, ...]
    solution: Solution  # modes, flux and background, and their status; of a robust loss its own covariance
    model_e: torch.Tensor  # (images, rows, columns)
    chi2_nu: torch.Tensor  # (images,)

    @classmethod
    def joined(cls, parts: Sequence[LiftResult]) -> LiftResult:
        if len(parts) == 1:
            return parts[0]
        solution = Solution.joined([part.solution for part in parts])
        return joined(parts, solution=solution)

    @property
    def zernike_nm(self) -> torch.Tensor:
        """Modes beyond the known wavefront, (images, modes)."""
        return self.solution.values[:, : len(self.nolls)]

    @property
    def covariance_nm2(self) -> torch.Tensor:
        """Inverse of their Fisher matrix (plus prior), the others marginalised, (images, modes, modes)."""
        return self.solution.covariance[:, : len(self.nolls), : len(self.nolls)]

    @property
    def sigma_nm(self) -> torch.Tensor:
        """Standard errors, (images, modes); the root is NumPy's, to the last bit that of the focus loop."""
        variance = torch.diagonal(self.covariance_nm2, dim1=1, dim2=2).clamp_min(0)
        return torch.from_numpy(np.sqrt(variance.cpu().numpy())).to(variance)

    def mode(self, noll: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return estimates and standard errors of one mode, (images,) each [nm]."""
        column = self.nolls.index(noll)
        return self.zernike_nm[:, column], self.sigma_nm[:, column]

    def updated(self, which: torch.Tensor, other: LiftResult, better: torch.Tensor) -> LiftResult:
        """The batch with members `which`, a mask of the batch, taken from `other` where that is `better`."""
        where = torch.nonzero(which)[better, 0]
        solution = self.solution.updated(where, other.solution, better)
        return mixed(self, other, where, better, solution=solution)


def lift(
    model: ImageModel,
    images_e: torch.Tensor,
    good: torch.Tensor,
    noise: NoiseModel,
    start_nm: torch.Tensor,
    options: LiftOptions = DEFAULTS,
    *,
    near: NearModel | None = None,
    beyond: bool = True,
    report: Callable[[int], Any] = lambda count: None,
) -> LiftResult:
    """Estimate the modes of `model` in every image.

    The effects of the `model` have no free parameters; its known wavefront has the diversity and, if
    calibrated, the NCPAs. Images are (images, rows, columns), `good` is (rows, columns), `start_nm` (images,
    modes). Where there is a quicker model `near` all images, the exact one has the last word only. Unless
    `beyond` is False, images whose estimate has run into the limits of a table are estimated again without
    it. `report` gets the number of images that were finished, for a progress bar.
    """
    images_e = images_e if images_e.is_floating_point() else images_e.double()

    def piece(own: tuple[torch.Tensor, torch.Tensor]) -> LiftResult:
        some, images_e = own[0], own[1].to(model.psf.device)
        close, device = near and near.of(some), images_e.device
        return _lift(model, close, images_e, good.to(device), noise, start_nm[some], options.of(some))

    pieces = in_pieces(model, near, torch.arange(len(images_e)), images_e)
    result = LiftResult.joined(process_map(piece, pieces, lambda own: report(len(own[0]))))
    stuck = model.at_limit(result.zernike_nm)
    if not (beyond and stuck.any()):
        return result
    again = lift(model.general, images_e[stuck], good, noise, start_nm[stuck], options.of(stuck))
    return result.updated(stuck, again, torch.ones(len(again.zernike_nm), dtype=torch.bool))


def in_pieces(
    model: ImageModel, near: NearModel | None, numbers: torch.Tensor, images: torch.Tensor
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Split `numbers` and `images` into those that a `model` estimates at once, and one `near` them."""
    size = at_once(IMAGES_AT_ONCE if near is None else NEAR_AT_ONCE, model.psf.device)
    count = max(1, math.ceil(len(images) / size))
    return list(zip(numbers.tensor_split(count), images.tensor_split(count), strict=True))


def _lift(model: ImageModel, near, images_e, good, noise, start_nm, options) -> LiftResult:
    """A fit with the variances of the images and, unless these are requested, one with those of the model."""
    nolls, quadratic = model.psf.nolls, options.loss_function.quadratic
    layout = Layout(nolls, prior_mean_nm=options.prior_mean_nm, prior_sigma_nm=options.prior_sigma_nm)
    x = layout.start(images_e.flatten(1) * good.flatten(), start_nm)
    variance = noise.variance_e2(smooth(images_e))
    problem = image_problem(near or model, layout, images_e, variance, good)
    if options.noise != "data":
        tolerance = COARSE_TOLERANCE if options.noise == "iterative" else ROUGH_TOLERANCE
        rough = problem.with_tolerance(tolerance)
        x = _finite(solve(rough, x, max_iterations=options.max_iterations), x)
        problem = _with_model_variance(problem, x, images_e, good, noise, options)
    posed = problem if quadratic else problem.with_loss(options.loss_function)
    if near is not None:
        x = _finite(solve(posed, x, max_iterations=options.max_iterations), x)
        posed = NearlySolved(posed, model).with_tolerance(CLOSE_TOLERANCE)
    solution = solve(posed, x, max_iterations=options.max_iterations)
    ended = _finite(solution, x)
    model_e = problem.predict_all(ended.to(images_e.device))
    if not quadratic:
        solution = replace(solution, covariance=posed.robust_covariance(ended))
    chi2_nu = problem.reduced_chi2_of(model_e).cpu()
    return LiftResult(nolls, solution, model_e.reshape(images_e.shape).cpu(), chi2_nu)


def _with_model_variance(rough: ImageFit, x, images_e, good, noise, options: LiftOptions) -> ImageFit:
    """The problem with the variances of the model at `x`, or of the model wherever it goes."""
    model, layout = rough.model, rough.layout
    if options.noise == "iterative" and options.loss_function.quadratic:
        return PhotonFit(model, layout, images_e[:, None].flatten(2), good.flatten(), noise)
    variance = noise.variance_e2(rough.predict_all(x.to(images_e.device))).reshape(images_e.shape)
    return image_problem(model, layout, images_e, variance, good)


def _finite(solution: Solution, before: torch.Tensor) -> torch.Tensor:
    """Where the fits ended, or where they began if they failed."""
    return torch.where(torch.isfinite(solution.values), solution.values, before)


def image_problem(
    model: ImageModel,
    layout: Layout,
    images_e: torch.Tensor,
    variance_e2: torch.Tensor,
    good: torch.Tensor,
) -> ImageFit:
    """Pose a problem of one image and one parameter vector each, for a whole batch.

    Images and variances are (images, rows, columns), `good` is (rows, columns).
    """
    variance = masked_variance(variance_e2, good)[:, None].flatten(2)
    device = model.psf.device
    kind = NearFit if isinstance(model, NearModel) else ImageFit
    return kind(model, layout, images_e[:, None].flatten(2).to(device), variance.to(device))


def smooth(images_e: torch.Tensor) -> torch.Tensor:
    """Smooth images by 3×3 pixels: a first idea of the noise-free signal, for the variances only."""
    padded = torch.nn.functional.pad(images_e[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    rows = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    return (rows[:, :, :-2] + rows[:, :, 1:-1] + rows[:, :, 2:]) / 9


REACH_NM = 500.0  # from the known wavefront, in every mode: fits that go further get lost in noise


class NearModel(ImageModel):
    """A coarse model with what it lacks of an `exact` one near the wavefronts (images, modes) of some images.

    What it lacks is taken to first order.
    """

    def __init__(self, exact: ImageModel, near_nm: torch.Tensor):
        assert isinstance(exact.psf, PsfModel)
        psf, optics = exact.psf.coarse(exact.optics)
        rough, one = ImageModel(psf, exact.effects), torch.ones(len(near_nm), dtype=torch.float64)
        super().__init__(psf, exact.effects)
        self._near_nm, self._last = near_nm, (NOTHING, optics)
        rough._last = self._last
        there = [model.predict_and_jacobian(near_nm, one, 0 * one, held=True) for model in (exact, rough)]
        (image, columns), (rough_image, rough_columns) = there
        self._slopes = (columns - rough_columns)[:, :-2].flatten(2)
        self._image = (image - rough_image).to(columns)

    def of(self, which: torch.Tensor) -> NearModel:
        """Return that of some of the images."""
        other = copy(self)
        other._near_nm, other._slopes, other._image = (
            one[which] for one in (self._near_nm, self._slopes, self._image)
        )
        return other

    @property
    def limits_nm(self) -> torch.Tensor:
        return torch.stack([self._near_nm - REACH_NM, self._near_nm + REACH_NM])

    def _unit(self, modes_nm, *arguments):
        return super()._unit(modes_nm, *arguments) + self._lacking(modes_nm)

    def _unit_and_jacobian(self, modes_nm, *arguments):
        unit, jacobian = super()._unit_and_jacobian(modes_nm, *arguments)
        return unit + self._lacking(modes_nm), jacobian + self._slopes.view_as(jacobian)

    def _unit_and_pullback(self, modes_nm):
        unit, to_modes = super()._unit_and_pullback(modes_nm)

        def pullback(factors: torch.Tensor) -> torch.Tensor:
            lacking = self._slopes @ factors.flatten(1)[..., None].to(self._slopes)
            return to_modes(factors) + lacking[..., 0]

        return unit + self._lacking(modes_nm), pullback

    def _lacking(self, modes_nm: torch.Tensor) -> torch.Tensor:
        ahead = (modes_nm - self._near_nm.to(modes_nm.device)).to(self._slopes)
        return self._image + (ahead[:, None] @ self._slopes).view_as(self._image)


def near(model: ImageModel, near_nm: torch.Tensor) -> NearModel | None:
    """A quicker `model` near the wavefronts (images, modes) of some images; None where there is none."""
    psf = model.psf
    if not (isinstance(psf, PsfModel) and model.can_pull_back):
        return None
    return NearModel(model, near_nm) if len(psf.weights) > 2 or model.optics.by_mode else None


class NearFit(ImageFit, CheapGradientProblem):
    """A fit of single images, with a `NearModel`, of which those that leave its limits are given up."""

    model: NearModel
    confined, cheap_gradient = True, ImageFit.gradient

    def _of(self, which: torch.Tensor) -> NearFit:
        return self._with(model=self.model.of(which))


class NearlySolved(ImageFit):
    """The fit of a `model` by exact gradients, with limits and Hessians of another that is `nearly` it."""

    confined = True

    def __init__(self, nearly: ImageFit, model: ImageModel):
        super().__init__(model, nearly.layout, nearly.images, nearly.root_weight.double() ** -2)
        self._nearly, self.lower, self.upper = nearly, nearly.lower, nearly.upper

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        return *self.gradient(x, which), self._nearly.normal_equations(x, which)[2]


class PhotonFit(ImageFit):
    """`ImageFit` of single images by their quasi-likelihood, see `NoiseModel`.

    Its slopes are those of least squares with the variances of the model as it is: the minimum is where
    endless re-weighting would end, but the objective is smooth and falls with every step. Images are (batch,
    1, pixels), `good` is (pixels,).
    """

    per_member = (*ImageFit.per_member, "_least")

    def __init__(
        self,
        model: ImageModel,
        layout: Layout,
        images_e: torch.Tensor,
        good: torch.Tensor,
        noise: NoiseModel,
    ):
        super().__init__(model, layout, images_e, torch.where(good, 1.0, torch.inf)[None, None])
        self._noise, self._good = noise, good.double()
        self._least = self._sum(images_e, images_e)

    def _sum(self, images_e: torch.Tensor, model_e: torch.Tensor) -> torch.Tensor:
        """Minus the quasi-likelihood of images (b, 1, pixels), (b,), float64."""
        pixels = self._noise.minus_quasi_likelihood(images_e.double(), model_e.double())
        return (pixels @ self._good)[:, 0]

    def _whitened(self, model_e: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        data = self.images[which.to(self.images.device)]
        model_e = model_e[:, None].to(data.dtype)
        root = self._noise.variance_e2(model_e).rsqrt() * self._good.to(data.dtype)
        return (data - model_e) * root, root

    def _value(self, residual: torch.Tensor, model_e: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        which = which.to(self.images.device)
        return self._sum(self.images[which], model_e[:, None]) - self._least[which]


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
