"""NCPA calibration: from a cube of frames to Zernike coefficients with errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..effects.base import OtfEffect, OtfGrid
from ..effects.transfer import Transfer
from ..noise import NoiseModel
from ..psf import PsfModel, PsfSettings
from .centring import start_tilts_nm
from .image_fit import ImageFit, masked_variance
from .lbfgs import solve_lbfgs
from .loss import LOSSES
from .methods import METHODS, Method
from .parameters import Layout
from .priors import ncpa_sigma_nm
from .scatter import covariance_of_mean
from .second_start import HIGHEST_NOLL, better, is_plausible, median_of_frames_nm
from .solve import Solution, solve
from .twin import TwinCheck, check_twin

FRAME_MARGIN_MAS = 100.0  # field beyond the window, for fits of single frames
LOCAL_PX = 5  # side of the square over which scatter is averaged


@dataclass(frozen=True)
class Frames:
    """Images of a calibration cube.

    Attributes
    ----------
    images_e : tensor, (frames, rows, columns)
    pixel_mask : tensor of bool, (rows, columns)
        True for good pixels.
    noise : NoiseModel
    """

    images_e: torch.Tensor
    pixel_mask: torch.Tensor
    noise: NoiseModel


@dataclass(frozen=True)
class CalibrationOptions:
    """Choices of the user; None takes the method's default.

    Attributes
    ----------
    method : str
        A key of `METHODS`.
    loss : str or None
        A key of `LOSSES`.
    optimiser : {"lm", "lbfgs"}
    highest_noll : int or None
        Modes Noll 2 to this are estimated.
    prior_scale : float or None
        Width of the prior in units of the NCPA law; None means no prior.
    """

    method: str = "long_exposure"
    loss: str | None = None
    optimiser: str = "lm"
    highest_noll: int | None = None
    prior_scale: float | None = 3.0
    max_iterations: int = 60

    def resolved(self) -> tuple[Method, CalibrationOptions]:
        """The method, and the options with its defaults filled in."""
        method = METHODS[self.method]
        return method, replace(
            self, loss=self.loss or method.loss, highest_noll=self.highest_noll or method.highest_noll
        )


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Attributes
    ----------
    nolls : tuple of int
    zernike_nm : ndarray, (modes,)
        Static wavefront without the diversity.
    covariance_nm2 : ndarray, (modes, modes)
        From the scatter over frames, autocorrelation included.
    effects : dict
        Public parameters of the OTF effects, by effect.
    effect_values : dict of str to ndarray
        Solver's parameters of each effect, for handing on.
    frames_nm : ndarray, (frames, modes)
        Coefficients per frame: fitted, or linearised about the mean image's solution.
    frame_status : list of str
        Per frame for per-frame methods, else one entry.
    mean_image_e, model_image_e, sigma_image_e : ndarray, (rows, columns)
    chi2_nu : float
        Of the mean image, against the scatter between frames.
    """

    options: CalibrationOptions
    nolls: tuple[int, ...]
    zernike_nm: np.ndarray
    covariance_nm2: np.ndarray
    effects: dict[str, dict[str, float]]
    effect_values: dict[str, np.ndarray]
    frames_nm: np.ndarray
    frame_status: list[str]
    iterations: np.ndarray
    mean_image_e: np.ndarray
    model_image_e: np.ndarray
    sigma_image_e: np.ndarray
    chi2_nu: float
    twin: TwinCheck | None
    seconds: float

    @property
    def sigma_nm(self) -> np.ndarray:
        """Standard errors, (modes,)."""
        return np.sqrt(np.diag(self.covariance_nm2))


def calibrate(
    frames: Frames,
    settings: PsfSettings,
    options: CalibrationOptions,
    effects: Sequence[OtfEffect] = (),
    *,
    start_nm: np.ndarray | None = None,
    device: str = "cpu",
    report: Callable[[int], None] | None = None,
) -> Calibration:
    """Estimate the static aberrations of a cube.

    Parameters
    ----------
    effects : sequence of OtfEffect
        Effects of the model; methods of the paper leave them out.
    start_nm : ndarray, (modes,), optional
        Start from Noll 2 on, for as many modes as there are; else the fit starts from none, and once more
        from single frames if it ends in a wrong minimum.
    report : callable, optional
        Called with the number of finished frames, for a progress bar.

    Raises
    ------
    ValueError
        With fewer than two frames.
    """
    if len(frames.images_e) < 2:
        raise ValueError("a calibration needs at least two frames")
    began = time.perf_counter()
    method, options = options.resolved()
    effects = tuple(effects) if method.effects else ()
    model = _model(settings, method, range(2, options.highest_noll + 1), device)
    transfer = Transfer(effects, OtfGrid(model.grid, model.wavelengths_m)) if effects else None
    problem = _problem(frames, model, method, options, transfer)
    solution = _solve(problem, _start(frames, problem, settings, start_nm), options, report)
    if method.effects and start_nm is None and not is_plausible(problem, solution):
        solution = better(solution, _solve(problem, _second_start(frames, problem, settings), options))
    return _result(frames, problem, method, options, solution, time.perf_counter() - began)


def _model(settings: PsfSettings, method: Method, nolls: Sequence[int], device: str) -> PsfModel:
    """PSF model: quick for single frames, whose noise hides the difference, exact for the mean.

    With the field of single frames, χ²/ν of the mean of 60 noise-limited frames was 1.14 instead of
    0.99, and the rounding of float32 kept its fit from converging.
    """
    if method.images == "mean":
        return PsfModel(settings, nolls, device=device, dtype=torch.float64)
    narrow = min(settings.margin_mas, FRAME_MARGIN_MAS)
    return PsfModel(replace(settings, margin_mas=narrow), nolls, device=device)


# -- the problem -----------------------------------------------------------------------------


def mean_variance_e2(frames: Frames) -> torch.Tensor:
    """Variance of the mean image [e-²], (rows, columns): the scatter between frames.

    The ratio of scatter to photon noise is averaged over 5×5 pixels, about λ/D, before it is held
    above one: pixel by pixel, scatter from few frames is uncertain, and its excursions would raise
    the variance and lower χ².
    """
    images = frames.images_e.double()
    photons = frames.noise.variance_e2(images.mean(0))
    ratio = _local_mean(images.var(0, correction=1) / photons, frames.pixel_mask.double())
    return photons * ratio.clamp_min(1.0) / len(images)


def _local_mean(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Weighted running mean over `LOCAL_PX` × `LOCAL_PX` pixels, (rows, columns)."""
    kernel = torch.ones(1, 1, LOCAL_PX, LOCAL_PX, dtype=values.dtype)
    total, norm = (
        torch.nn.functional.conv2d(plane[None, None], kernel, padding=LOCAL_PX // 2)[0, 0]
        for plane in (torch.where(weight > 0, values * weight, 0.0), weight)
    )
    return total / norm.clamp_min(1.0)


def _problem(
    frames: Frames, model: PsfModel, method: Method, options: CalibrationOptions, transfer: Transfer | None
) -> ImageFit:
    prior = None if options.prior_scale is None else ncpa_sigma_nm(model.nolls, options.prior_scale)
    layout = Layout(model.nolls, transfer.parameters if transfer else (), prior_sigma_nm=prior)
    images, variance = _data(frames, method)
    variance = masked_variance(variance, frames.pixel_mask).flatten(-2)
    return ImageFit(
        model,
        layout,
        images.flatten(2).to(model.device),
        variance.to(model.device),
        transfer=transfer,
        loss=LOSSES[options.loss],
    )


def _data(frames: Frames, method: Method) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (batch, repeats, rows, columns) and their variance, as the method wants them."""
    images = frames.images_e
    if method.images == "mean":
        return images.double().mean(0)[None, None], mean_variance_e2(frames)[None, None]
    variance = frames.noise.variance_e2(images.double().mean(0))
    if method.images == "frames":
        return images[:, None], variance[None, None]
    flux = images.double().sum((1, 2))
    return (images * (flux.mean() / flux)[:, None, None].to(images.dtype))[None], variance[None, None]


def _start(frames: Frames, problem: ImageFit, settings: PsfSettings, start_nm=None) -> torch.Tensor:
    """Tip and tilt from the centroids and no aberrations, or the first modes of `start_nm`."""
    first = problem.images.double().mean(1).cpu()
    x = problem.layout.start(first)
    masked = first.reshape(-1, *settings.window) * frames.pixel_mask
    x[:, :2] = start_tilts_nm(masked, settings.pixel_scale_mas, settings.geometry.diameter_m)
    if start_nm is not None:
        common = min(len(start_nm), len(problem.layout.nolls))
        x[:, :common] = torch.as_tensor(start_nm[:common])
    return x


def _second_start(frames: Frames, problem: ImageFit, settings: PsfSettings) -> torch.Tensor:
    """The start with what single frames tell of the low modes."""
    nolls = [noll for noll in problem.layout.nolls if noll <= HIGHEST_NOLL]
    model = _model(settings, METHODS["lift_slices"], nolls, problem.model.device)
    median_nm = median_of_frames_nm(model, frames.images_e, frames.pixel_mask, frames.noise)
    return _start(frames, problem, settings, median_nm)


def _solve(problem: ImageFit, start: torch.Tensor, options: CalibrationOptions, report=None) -> Solution:
    if options.optimiser == "lbfgs":
        return solve_lbfgs(problem, start, max_iterations=5 * options.max_iterations)
    return solve(problem, start, max_iterations=options.max_iterations, report=report)


# -- the result ------------------------------------------------------------------------------


def _result(
    frames: Frames,
    problem: ImageFit,
    method: Method,
    options: CalibrationOptions,
    solution: Solution,
    seconds: float,
) -> Calibration:
    modes = problem.layout.modes
    usable = np.array([status != "invalid" for status in solution.status])
    if method.images == "frames":
        per_frame = solution.values[:, modes].numpy()
        per_frame = np.where(usable[:, None], per_frame, np.nan)
        values = solution.values[torch.as_tensor(usable)].mean(0, keepdim=True)
    else:
        values = solution.values[:1]
        per_frame = _linear_estimates(frames, problem, solution)
    mean, sigma = frames.images_e.double().mean(0), mean_variance_e2(frames).sqrt()
    model_image = problem.predict(values)[0].reshape(mean.shape).cpu()
    pull = ((mean - model_image) / sigma)[frames.pixel_mask]
    transfer = problem.transfer
    effect_values = values[0, problem.layout.effect_values].numpy()
    return Calibration(
        options,
        problem.layout.nolls,
        values[0, modes].numpy(),
        covariance_of_mean(per_frame[np.isfinite(per_frame).all(1)]),
        transfer.describe(effect_values) if transfer else {},
        transfer.split(effect_values) if transfer else {},
        per_frame,
        solution.status,
        solution.iterations.numpy(),
        mean.numpy(),
        model_image.numpy(),
        sigma.numpy(),
        float((pull**2).sum() / (len(pull) - problem.layout.size)),
        check_twin(problem, solution.values[:1], solution.objective[0]) if method.images == "mean" else None,
        seconds,
    )


def _linear_estimates(frames: Frames, problem: ImageFit, solution: Solution) -> np.ndarray:
    """Coefficients per frame by one linear step from the shared solution, (frames, modes).

    Their mean is the solution; their scatter carries photon noise, speckle and real changes.
    """
    x = solution.values[:1]
    _, jacobian = problem.predict_and_jacobian(x)
    weight = problem.root_weight[0].double().mean(0) ** 2
    gain = solution.covariance[0, problem.layout.modes] @ (jacobian[0].double() * weight).cpu()
    images = frames.images_e.double().flatten(1)
    flux = images.sum(1, keepdim=True)
    deviation = images * (flux.mean() / flux) - images.mean(0)
    return (x[0, problem.layout.modes] + (deviation @ gain.mT)).numpy()
