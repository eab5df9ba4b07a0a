"""LIFT on all frames of a ramp: effects, start, object fit, estimate, second try for outliers.

Parameters that all images share, object size and AO residual, are fitted jointly. In one image the size of
the object and the defocus are degenerate, which is why the paper tuned the kernel by hand; on a ramp the
defocus changes and the object does not. The per-image parameters are eliminated from the joint normal
equations by the Schur complement, so the cost is that of LIFT plus one small system. Speckles that a frame
did not average out count as further noise: the variances grow by χ²/ν, as of few frames in
`calibration_errors`, so that priors keep their weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS, TIP_TILT
from irlos_pipe.effects import Effect, EffectSet, FixedEffect, SeeingHalo, TipTiltJitter
from irlos_pipe.effects.base import labels_of
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.estimate.calibration_errors import public_errors
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.image_fit import FRAMES_PER_CHUNK, ImageFit, Layout
from irlos_pipe.estimate.lift import LiftResult, image_problem, lift, smooth
from irlos_pipe.estimate.starts import STEP_NM, evenly, scan_start_nm, start_tilts_nm
from irlos_pipe.estimate.tabulated import tabulated
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.parallel import at_once
from irlos_pipe.numerics.solver import CONVERGED, MAX_ITERATIONS, ROUNDING, scaled_inverse, solve
from irlos_pipe.optics.light_path import LightPath

OUTLIER_CHI2 = 2.0  # a fit this much worse than the median of the ramp gets a second try
SHARED_FRAMES = 24  # frames that determine what all share, at most: more take long and add little
MIN_FRAMES = 3  # frames from which a table of images saves more time than it takes to make


@dataclass(frozen=True)
class RampData:
    """Frames of a ramp in order of recording.

    Shapes: `images_e` (frames, rows, columns), `good` (rows, columns) of bool, `introduced_nm` (frames,).
    """

    images_e: torch.Tensor
    good: torch.Tensor
    noise: NoiseModel
    introduced_nm: np.ndarray

    def of(self, which: torch.Tensor) -> RampData:
        return replace(self, images_e=self.images_e[which], introduced_nm=self.introduced_nm[which.numpy()])


@dataclass(frozen=True)
class RampFit:
    result: LiftResult
    model: ImageModel  # the one used, its effects held at what was found
    effects: dict[str, dict[str, float]]  # their public parameters
    shared: SharedFit | None  # where effect parameters were fitted to the whole ramp
    start_nm: torch.Tensor  # (frames, modes)
    # standard errors of the public parameters of `shared`
    sigma: dict[str, dict] = field(default_factory=dict)

    @property
    def defocus_nm(self) -> np.ndarray:
        """Defocus of every frame, (frames,); NaN where the fit is invalid."""
        valid = np.array([status != "invalid" for status in self.result.solution.status])
        return np.where(valid, self.result.mode(DEFOCUS)[0].numpy(), np.nan)


def start_from_defocus(model: LightPath, data: RampData, defocus_nm: np.ndarray) -> torch.Tensor:
    """Start a `model` at `defocus_nm` for the frames of `data`; tip and tilt from the centroids.

    The centroids are relative to those of the model's own images.
    """
    start = torch.zeros(len(data.images_e), len(model.nolls), dtype=torch.float64)
    start[:, model.nolls.index(DEFOCUS)] = torch.as_tensor(np.nan_to_num(defocus_nm))
    seen = start_tilts_nm((data.images_e * data.good).double(), model.settings)
    modelled = start_tilts_nm(model.images(start).double(), model.settings)
    for axis, noll in enumerate(TIP_TILT):
        if noll in model.nolls:
            start[:, model.nolls.index(noll)] = (seen - modelled)[:, axis]
    return start


def fit_ramp(
    model: LightPath,
    data: RampData,
    start_nm: torch.Tensor,
    options: LiftOptions,
    effects: Sequence[Effect] = (),
    *,
    seen: np.ndarray | None = None,
    report: Callable[[int], Any] = lambda count: None,
) -> RampFit:
    """Estimate every frame; effects with free parameters are first fitted to the whole ramp.

    Fixed `effects` stay, free parameters are shared by all frames; the frames `seen` (frames,), by default
    all, determine these. Estimates start at `start_nm` (frames, modes); for `report` see `lift`.
    """
    free = EffectSet(effects, model.grids)
    which = torch.nonzero(torch.as_tensor(np.ones(len(start_nm), bool) if seen is None else seen))[:, 0]
    which = which[evenly(len(which), SHARED_FRAMES)]
    shared = None
    if free.parameters:
        some, layout = data.of(which), Layout(model.nolls)
        variance = data.noise.variance_e2(smooth(some.images_e))
        problem = image_problem(ImageModel(model, free), layout, some.images_e, variance, data.good)
        start = layout.start((some.images_e * data.good).flatten(1), start_nm[which])
        shared = fit_shared(problem, start)
    held = free.held(shared.values if shared else NOTHING)
    complete = ImageModel(model, held)
    if len(start_nm) >= MIN_FRAMES:
        complete = tabulated(complete, start_nm)
    result = lift(complete, data.images_e, data.good, data.noise, start_nm, options, report=report)
    result = second_try(complete, data, result, options)
    sigma = public_errors(free, shared.values, shared.covariance.numpy()) if shared else {}
    return RampFit(result, complete, held.describe(NOTHING), shared, start_nm, sigma)


def second_try(model: ImageModel, data: RampData, result: LiftResult, options: LiftOptions) -> LiftResult:
    """Restart frames that failed, fit badly or contradict the defocus scan; keep whichever fits better.

    To stand out, a bad fit needs good ones next to it; the scan judges every frame by itself. Arguments are
    those of `fit_ramp`, `result` is that of the first try.
    """
    if not {2, 3, 4} <= set(model.psf.nolls):
        return result
    start = scan_start_nm(model.psf, data.images_e, data.good, model.optics)
    finite, focus = result.chi2_nu[torch.isfinite(result.chi2_nu)], result.nolls.index(4)
    typical = finite.median() if len(finite) else 1.0
    contradicted = (result.zernike_nm[:, focus] - start[:, focus]).abs() > STEP_NM
    failed = ~result.solution.converged | ~(result.chi2_nu < OUTLIER_CHI2 * typical)
    suspect = failed | contradicted
    if not suspect.any():
        return result
    images_e, own = data.images_e[suspect], options.of(suspect)
    again = lift(model, images_e, data.good, data.noise, start[suspect], own)
    better = again.solution.converged & ~(again.chi2_nu > result.chi2_nu[suspect] * 0.999)
    better |= again.solution.converged & ~result.solution.converged[suspect]
    return result.updated(suspect, again, better)


def ramp_effects(
    available: Sequence[Effect],
    known: Mapping[str, FixedEffect],
    halo: str = "calibrated",
    object_sigma_mas: str | float = "calibrated",
) -> list[Effect]:
    """Choose the effects for `fit_ramp` from the `available` ones of the model.

    A calibration has measured the `known` ones, by label. Of the others, residual and jitter are taken as
    expected, and the rest as `available` has them: a free one is fitted to the whole ramp. The `halo` is
    "calibrated", "fit" or "off"; `object_sigma_mas`, the size of the Gaussian kernel that stands for object
    and jitter, may also be "calibrated" or "fit".
    """
    labelled = dict(zip(labels_of(available), available, strict=True))
    best = {label: known.get(label) or effect.expected() for label, effect in labelled.items()}
    residual, kernel = best.pop(SeeingHalo.name, None), best.pop(TipTiltJitter.name, None)
    if halo == "off":
        residual = None
    elif halo == "fit" and residual is not None:
        residual = FixedEffect(residual.base, residual.all_values(()).tolist(), free=("variance_nm2",))
    if object_sigma_mas != "calibrated":
        jitter = TipTiltJitter()
        fitted = object_sigma_mas == "fit"
        kernel = jitter if fitted else FixedEffect(jitter, jitter.values_of(float(object_sigma_mas)))
    rest = [known.get(label, effect) for label, effect in labelled.items() if label in best]
    return [effect for effect in (residual, kernel, *rest) if effect is not None]


OUTER_ITERATIONS = 12
STEP_SIGMA = 0.02  # converged when no shared parameter will move by more than this part of its error
# Fall of χ² per image that does not matter at the start: the per-image parameters make their last steps
# together with the shared ones.
ON_THE_WAY = 1.0


@dataclass(frozen=True)
class SharedFit:
    """Shared effect parameters with their covariance, and the per-image parameters at the optimum."""

    values: torch.Tensor  # (shared,)
    # (shared, shared), per-image parameters marginalised, the misfit counted as noise
    covariance: torch.Tensor
    x: torch.Tensor  # (images, parameters)
    status: str


def fit_shared(problem: ImageFit, x: torch.Tensor) -> SharedFit:
    """Fit the free effect parameters of a problem's model to all its images together.

    The `problem` has one parameter vector per image, which starts at `x` (images, parameters); its effects
    have free parameters.
    """
    parameters = problem.model.effects.parameters
    limits = torch.tensor([[p.lower, p.upper] for p in parameters], dtype=torch.float64)
    mean = torch.tensor([p.prior_mean for p in parameters], dtype=torch.float64)
    precision = torch.tensor([p.prior_sigma for p in parameters], dtype=torch.float64) ** -2
    values, before, lowest = problem.model.effects.starts, math.inf, math.inf
    status = MAX_ITERATIONS
    x = kept = _own_parameters(problem, x, values)
    for _ in range(OUTER_ITERATIONS):
        chi2, steps, *reduced = _linearised(problem, x, values)
        if not chi2 <= lowest * (1 + ROUNDING):  # the images have not followed by a step
            x = _own_parameters(problem, kept, values)
            chi2, steps, *reduced = _linearised(problem, x, values)
        gradient = reduced[0] + precision * (values - mean)
        covariance = torch.linalg.inv(reduced[1] + torch.diag(precision))
        trial = (values - covariance @ gradient).clamp(limits[:, 0], limits[:, 1])
        step = float(((trial - values).abs() / torch.diagonal(covariance).sqrt()).max())
        kept, x, lowest = x, x + steps @ torch.cat([values - trial, values.new_ones(1)]), chi2
        values = trial
        # what further steps will add up to, if they go on to shrink as the last one did; else the last one
        ahead = step**2 / (before - step) if step < before < math.inf else step
        if ahead < STEP_SIGMA:
            status = CONVERGED
            break
        before = step
    return SharedFit(values, covariance, x, status)


def _own_parameters(problem: ImageFit, x: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Per-image parameters, the shared ones held at `values`, from a table of images if there can be one."""
    model, modes = problem.model, problem.layout.modes
    held = tabulated(ImageModel(model.psf, model.effects.held(values)), x[:, modes])
    alone = problem.with_model(held).with_tolerance(ON_THE_WAY)
    found = solve(alone, x, max_iterations=20).values
    return torch.where(torch.isfinite(found), found, x)


def _linearised(problem: ImageFit, x: torch.Tensor, values: torch.Tensor):
    """χ², steps of the per-image parameters, and gradient and information of the shared ones without these.

    The steps (images, parameters, shared + 1) are those per unit by which a shared parameter falls and, last,
    those while all stay. Gradient and information are in units of the misfit, χ²/ν where it is above 1.
    """
    gradient = torch.zeros_like(values)
    information = torch.zeros(len(gradient), len(gradient), dtype=torch.float64)
    chi2, own, steps = 0.0, problem.layout.size, []
    modes = len(problem.layout.nolls)
    order = [*range(modes), -2, -1, *range(modes, modes + len(gradient))]  # the shared ones last
    size = at_once(FRAMES_PER_CHUNK, problem.device)
    for part, which in zip(x.split(size), torch.arange(len(x)).split(size), strict=True):
        modes_nm = part[:, problem.layout.modes].to(problem.device)
        image, columns = problem.model.predict_and_jacobian(modes_nm, part[:, -2], part[:, -1], values)
        numbers = which.to(problem.images.device)
        root = problem.root_weight[numbers, 0].double()
        residual = (problem.images[numbers, 0].double() - image.flatten(1)) * root
        columns = columns[:, order].flatten(2).double() * root[:, None]
        force, normal = (columns @ residual[..., None]).cpu(), (columns @ columns.mT).cpu()
        normal[:, :own, :own] += torch.diag_embed(problem.prior_precision[which])
        right = torch.cat([normal[:, :own, own:], force[:, :own]], dim=2)
        steps.append(scaled_inverse(normal[:, :own, :own]) @ right)
        eliminated = normal[:, own:, :own] @ steps[-1]
        gradient -= (force[:, own:, 0] - eliminated[..., -1]).sum(0)
        information += (normal[:, own:, own:] - eliminated[..., :-1]).sum(0)
        chi2 += float(residual.square().sum())
    misfit = max(1.0, chi2 / (problem.freedom * len(x)))
    return chi2, torch.cat(steps), gradient / misfit, information / misfit
