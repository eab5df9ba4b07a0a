"""NCPA calibration: from a cube of frames to Zernike coefficients with errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.cube import Frames, covariance_of_mean, mean_variance_e2
from irlos_pipe.estimate.drift import drifts, measured_drift
from irlos_pipe.estimate.frame_fits import fit_frames
from irlos_pipe.estimate.image_fit import ImageFit, masked_variance
from irlos_pipe.estimate.lbfgs import solve_lbfgs
from irlos_pipe.estimate.methods import METHODS, Method
from irlos_pipe.estimate.parameters import Layout, NcpaPrior
from irlos_pipe.estimate.search import located
from irlos_pipe.estimate.starts import (
    START_HIGHEST_NOLL,
    better,
    is_plausible,
    median_of_frames_nm,
    start_tilts_nm,
)
from irlos_pipe.estimate.total_wavefront import effects_in_modes_nm
from irlos_pipe.estimate.twin import TwinCheck, check_twin
from irlos_pipe.frames.blocks import blocks
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.numerics.loss import LOSSES
from irlos_pipe.numerics.solution import Solution
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import PsfSettings

ROUGH_ITERATIONS = 6  # of the few frames whose median all others start from


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
    prior : NcpaPrior or None
    """

    method: str = "long_exposure"
    loss: str | None = None
    optimiser: str = "lm"
    highest_noll: int | None = None
    prior: NcpaPrior | None = None
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
        Static wavefront without the diversity, the part of effects in the pupil included.
    modes_nm : ndarray, (modes,)
        The same without that part: what goes with the effects in a model.
    covariance_nm2 : ndarray, (modes, modes)
        From the scatter over frames, autocorrelation included.
    effects : dict
        Public parameters of the effects, by effect.
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
    modes_nm: np.ndarray
    covariance_nm2: np.ndarray
    effects: dict[str, dict]
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
    effects: Sequence[Effect] = (),
    *,
    start_nm: np.ndarray | None = None,
    device: str = "cpu",
    report: Callable[[int], None] | None = None,
) -> Calibration:
    """Estimate the static aberrations of a cube.

    Parameters
    ----------
    effects : sequence of Effect
        Of the model; methods of the paper leave them out.
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
    psf = _psf_model(settings, method, range(2, options.highest_noll + 1), device)
    task = _Task(frames, psf, method, options, start_nm, report)
    steady = [effect for effect in effects if not drifts(effect)]
    fit = _fit_steady(task, steady)
    for effect in effects:
        if drifts(effect):
            frames_nm = _linear_estimates(frames, *fit)[1]
            fit = task.fit([*fit[0].model.effects.effects, measured_drift(effect, psf.nolls, frames_nm)], fit)
    return _result(task, *fit, time.perf_counter() - began)


@dataclass(frozen=True)
class _Task:
    """What is to be fitted, whatever the effects in the model."""

    frames: Frames
    psf: PsfModel
    method: Method
    options: CalibrationOptions
    start_nm: np.ndarray | None
    report: Callable[[int], None] | None

    def fit(
        self, effects: Sequence[Effect], near: tuple[ImageFit, Solution] | None = None
    ) -> tuple[ImageFit, Solution]:
        """Fit with these effects, from scratch or from the modes of another fit."""
        problem = _problem(self.frames, ImageModel(self.psf, effects), self.method, self.options)
        if self.method.images == "frames" and self.start_nm is None:
            start = _frames_start(self.frames, problem)
        else:
            start = _start(self.frames, problem, self.psf.settings, self.start_nm)
        if near is not None:
            start[:, problem.layout.modes] = near[1].values[:, near[0].layout.modes]
        solution = _solve(problem, start, self.options, self.report)
        alone = near is None and self.start_nm is None
        if alone and self.method.effects and not is_plausible(problem, solution):
            again = _second_start(self.frames, problem, self.psf)
            solution = better(solution, _solve(problem, again, self.options))
        return problem, solution


def _fit_steady(task: _Task, effects: Sequence[Effect]) -> tuple[ImageFit, Solution]:
    """Fit with all effects; those whose place is unknown are searched for in what the others leave."""
    fit = task.fit([effect for effect in effects if not effect.needs_search])
    if not any(effect.needs_search for effect in effects):
        return fit
    return task.fit(located(fit[0], fit[1].values[:1], effects), fit)


def _psf_model(settings: PsfSettings, method: Method, nolls: Sequence[int], device: str) -> PsfModel:
    """PSF model: quick for single frames, exact for the mean; rounding of float32 would stall its fit."""
    if method.images == "mean":
        return PsfModel(settings, nolls, device=device, dtype=torch.float64)
    return PsfModel(settings.for_single_frames(), nolls, device=device)


# -- the problem -----------------------------------------------------------------------------


def _problem(frames: Frames, model: ImageModel, method: Method, options: CalibrationOptions) -> ImageFit:
    nolls, device = model.psf.nolls, model.psf.device
    prior = None if options.prior is None else options.prior.sigma_nm(nolls)
    layout = Layout(nolls, model.effects.parameters, prior_sigma_nm=prior)
    images, variance = _data(frames, method)
    variance = masked_variance(variance, frames.pixel_mask).flatten(-2)
    return ImageFit(
        model, layout, images.flatten(2).to(device), variance.to(device), loss=LOSSES[options.loss]
    )


def _data(frames: Frames, method: Method) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (batch, repeats, rows, columns) and their variance, as the method wants them."""
    images = frames.images_e
    if method.images == "mean":
        return frames.mean_e[None, None], mean_variance_e2(frames)[None, None]
    variance = frames.noise.variance_e2(frames.mean_e)
    if method.images == "frames":
        return images[:, None], variance[None, None]
    flux = frames.flux_e
    return (images * (flux.mean() / flux)[:, None, None].to(images.dtype))[None], variance[None, None]


def _start(frames: Frames, problem: ImageFit, settings: PsfSettings, start_nm=None) -> torch.Tensor:
    """Tip and tilt from the centroids and no aberrations, or the first modes of `start_nm`."""
    x = torch.empty(len(problem.images), problem.layout.size, dtype=torch.float64)
    for block in blocks(len(x)):
        x[block] = _centred(problem.images[block], frames.pixel_mask, problem.layout, settings)
    if start_nm is not None:
        common = min(len(start_nm), len(problem.layout.nolls))
        x[:, :common] = torch.as_tensor(start_nm[:common])
    return x


def _centred(images, pixel_mask, layout: Layout, settings: PsfSettings) -> torch.Tensor:
    """Start of members from images (b, repeats, pixels): flux, and tip and tilt of the centroid."""
    first = images.double().mean(1).cpu()
    x = layout.start(first)
    masked = first.reshape(-1, *settings.window) * pixel_mask
    x[:, :2] = start_tilts_nm(masked, settings.pixel_scale_mas, settings.geometry.diameter_m)
    return x


def _frames_start(frames: Frames, problem: ImageFit) -> torch.Tensor:
    """What a few frames agree on, which is close for all; tip and tilt of every frame by itself."""
    model = problem.model.psf
    median_nm = median_of_frames_nm(model, frames.images_e, frames.pixel_mask, frames.noise, ROUGH_ITERATIONS)
    x = _start(frames, problem, model.settings)
    scale, diameter = model.settings.pixel_scale_mas, model.settings.geometry.diameter_m
    modelled = start_tilts_nm(model.images(median_nm[None]).double().cpu(), scale, diameter)
    x[:, :2] += median_nm[:2] - modelled
    x[:, 2 : len(median_nm)] = median_nm[2:]
    return x


def _second_start(frames: Frames, problem: ImageFit, psf: PsfModel) -> torch.Tensor:
    """The start with what single frames tell of the low modes."""
    nolls = [noll for noll in psf.nolls if noll <= START_HIGHEST_NOLL]
    model = _psf_model(psf.settings, METHODS["lift_slices"], nolls, psf.device)
    median_nm = median_of_frames_nm(model, frames.images_e, frames.pixel_mask, frames.noise)
    return _start(frames, problem, psf.settings, median_nm)


def _solve(problem: ImageFit, start: torch.Tensor, options: CalibrationOptions, report=None) -> Solution:
    if options.optimiser == "lbfgs":
        return solve_lbfgs(problem, start, max_iterations=5 * options.max_iterations)
    fit = fit_frames if METHODS[options.method].images == "frames" else solve
    return fit(problem, start, max_iterations=options.max_iterations, report=report)


# -- the result ------------------------------------------------------------------------------


def _result(task: _Task, problem: ImageFit, solution: Solution, seconds: float) -> Calibration:
    frames, method = task.frames, task.method
    layout, effects = problem.layout, problem.model.effects
    modes = layout.modes
    usable = np.array([status != "invalid" for status in solution.status])
    if method.images == "frames":
        per_frame = solution.values[:, modes].numpy()
        per_frame = np.where(usable[:, None], per_frame, np.nan)
        values = solution.values[torch.as_tensor(usable)].mean(0, keepdim=True)
        total_nm = values[0, modes].numpy()
    else:
        values = solution.values[:1]
        total_nm, per_frame = _linear_estimates(frames, problem, solution)
    mean, sigma = frames.mean_e, mean_variance_e2(frames).sqrt()
    model_image = problem.predict(values)[0].reshape(mean.shape).cpu()
    pull = ((mean - model_image) / sigma)[frames.pixel_mask]
    effect_values = values[0, layout.effect_values]
    return Calibration(
        task.options,
        layout.nolls,
        total_nm,
        values[0, modes].numpy(),
        covariance_of_mean(per_frame[np.isfinite(per_frame).all(1)]),
        effects.describe(effect_values),
        effects.split(effect_values),
        per_frame,
        solution.status,
        solution.iterations.numpy(),
        mean.numpy(),
        model_image.numpy(),
        sigma.numpy(),
        float((pull**2).sum() / (len(pull) - layout.size)),
        check_twin(problem, solution.values[:1], solution.objective[0]) if method.images == "mean" else None,
        seconds,
    )


def _linear_estimates(frames: Frames, problem: ImageFit, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the whole wavefront, (modes,), and per frame, (frames, modes).

    The latter by one linear step from the shared solution: their mean is the solution, their scatter
    carries photon noise, speckle and real changes.
    """
    x, layout = solution.values[:1], problem.layout
    added, slopes = effects_in_modes_nm(problem.model.effects, x[0, layout.effect_values], layout.nolls)
    read = torch.zeros(len(layout.nolls), layout.size, dtype=torch.float64)
    read[:, layout.modes] = torch.eye(len(layout.nolls), dtype=torch.float64)
    read[:, layout.effect_values] = slopes.double()
    _, jacobian = problem.predict_and_jacobian(x)
    weight = problem.root_weight[0].double().mean(0) ** 2
    gain = read @ solution.covariance[0] @ (jacobian[0].double() * weight).cpu()
    images, mean, flux = frames.images_e.flatten(1), frames.mean_e.flatten(), frames.flux_e[:, None]
    total = x[0, layout.modes] + added
    per_frame = torch.empty(len(images), len(total), dtype=torch.float64)
    for block in blocks(len(images)):
        per_frame[block] = total + (images[block] * (flux.mean() / flux[block]) - mean) @ gain.mT
    return total.numpy(), per_frame.numpy()
