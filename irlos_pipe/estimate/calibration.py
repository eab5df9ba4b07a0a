"""NCPA calibration: from a cube of frames to Zernike coefficients with errors."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from scipy.optimize import brentq

from irlos_pipe.conventions.units import NM, resolution_px, tilt_nm
from irlos_pipe.effects import Effect, FixedEffect
from irlos_pipe.effects.base import occurrences
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.estimate.calibration_errors import (
    ErrorsFrom,
    NominalChi2,
    effect_errors,
    errors_of,
    nominal_of,
    nominal_power,
)
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions, OneSetup, TwinCheck
from irlos_pipe.estimate.causes import EXPLAINED
from irlos_pipe.estimate.cube import Frames, Motion, covariance_of_mean, kurtosis_of_frames, mean_variance_e2
from irlos_pipe.estimate.image_fit import Fit, ImageFit
from irlos_pipe.estimate.methods import CubeFit, Report, linear_estimates, scheme_of, silent
from irlos_pipe.estimate.open_fit import (
    Opened,
    OpenFit,
    TailLaw,
    finished,
    likelier_minimum,
    likelier_side,
    open_basis,
)
from irlos_pipe.estimate.score_test import Mirrored, best_start, mirrored, uneven
from irlos_pipe.optics.image_quality import Curve, power_spectrum
from irlos_pipe.optics.psf_settings import PsfSettings

MISFIT, MISFIT_ROUNDS = 1.3, 3  # χ²/ν from which few frames are weighted by the misfit, and how often at most


@dataclass(frozen=True, kw_only=True)
class SetupFit(OneSetup):
    """The same with its images, (rows, columns) each."""

    mean_e: np.ndarray
    model_e: np.ndarray
    sigma_e: np.ndarray


@dataclass(frozen=True)
class Calibration:
    options: CalibrationOptions  # the method's defaults filled in
    nolls: tuple[int, ...]
    # (modes,), total static wavefront beyond the known one, the part of effects in the pupil included
    zernike_nm: np.ndarray
    fitted_modes_nm: np.ndarray  # (modes,), the same without that part: what goes with the effects in a model
    covariance_nm2: np.ndarray  # (modes, modes), see `errors_from`
    # The scatter over frames, autocorrelation included; of too few frames the noise model, with or without
    # their scatter; all grow by what the model misfits (see `calibration_errors`).
    errors_from: ErrorsFrom
    effects: dict[str, dict]  # public parameters, by effect
    effect_values: dict[str, np.ndarray]  # solver's parameters of each effect, for handing on
    frames_nm: np.ndarray  # (frames, modes), per frame: fitted, or linearised about the mean image's solution
    frame_status: list[str]  # per frame for per-frame methods, else one entry
    iterations: np.ndarray
    mean_image_e: np.ndarray  # (rows, columns), as the two that follow
    model_image_e: np.ndarray
    sigma_image_e: np.ndarray
    chi2_nu: float  # of the mean image, against the scatter between frames
    nominal: NominalChi2  # what it would be about a model that lacks nothing
    noise_ratio: float  # see `Frames.noise_ratio`
    window_resolutions: float  # smaller side of the window in λ/D, at the longest wavelength
    kurtosis: float  # of the frames, see `kurtosis_of_frames`
    twin: TwinCheck | None  # of the closed basis
    tail: TailLaw | None  # law of the modes beyond it; None where there are none
    seconds: float = math.nan
    # standard errors of `effects`, see `effect_errors`
    effects_sigma: dict[str, dict] = field(default_factory=dict)
    # power spectrum of the residual over its standard error, see `image_quality.power_spectrum`
    left: Curve | None = None
    # how much of a mirrored pupil the mean image shows, where that was looked at
    mirrored: Mirrored | None = None
    motion: Motion | None = None  # of the star from frame to frame, where the frames were `steadied`
    # what a complete model would leave of `left`, see `calibration_errors.nominal_power`
    left_nominal: np.ndarray | None = None
    fit: Fit | None = None  # of one star's mean image, for `causes`
    setups: Sequence[SetupFit] = ()  # where several were fitted together
    adjusted: bool = False  # whether facts of the instrument were free
    introduced_accuracy: float = math.nan  # of their introduced defoci, as a part of them; see `setups`

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
    adjustable: Sequence[Effect] = (),
    adjust_always: bool = False,
    start_nm: np.ndarray | None = None,
    device: str = "cpu",
    report: Report = silent,
    note: Callable[[str], None] = lambda line: None,
) -> Calibration:
    """Estimate the static aberrations of a cube, or of a single image.

    Where the images show that the AO residual is uneven over the pupil, the model has this as well.

    The `effects` are those of the model; methods of the paper leave them out. What of the instrument is
    `adjustable` may be free jointly with all modes, for an open basis. Copies of the star among it enter
    where they explain most of what all else leaves above nominal. Other minima than those from the sides of a
    displaced stop are not looked for then. Unless to `adjust_always`, the images have to contradict the
    instrument as declared, and to agree with one that any instrument could be.

    The fit starts at `start_nm` (modes,) from Noll 2 on, for as many modes as there are; else from none, and
    once more from single frames if it ends in a wrong minimum. A fit of all modes that does so goes on from
    others (see `open_fit`). `report` gets the number of finished frames, for a progress bar, and `note` a
    line after every step, for a log.
    """
    began = time.perf_counter()
    options = options.resolved()
    effects = tuple(effects) if METHODS[options.method].effects else ()
    psf = scheme_of(options).psf_model(settings, range(2, options.last_noll + 1), device)
    task = CubeFit(frames, psf, options, start_nm, report)
    steady = [effect for effect in effects if not drifts(effect)]
    fit = _fit_steady(task, steady)
    note(f"Noll 2 to {psf.nolls[-1]} fitted")
    if (
        not frames.show_scatter
        and METHODS[options.method].effects
        and not _explained_by_tail(task, effects, fit)
    ):
        task, fit = _weighted_by_misfit(task, steady, fit)
    for effect in effects:
        if drifts(effect):
            frames_nm = linear_estimates(frames, fit).frames_nm
            drift = measured_drift(effect, psf.nolls, frames_nm)
            fit = task.fit([*fit.problem.model.effects.effects, drift], fit)
    closed, opened, nominal, adjusted = fit, _all_modes(task, effects, fit), None, False
    if opened is not None and any(starts_as_told(effect) for effect in steady):
        closed, opened = _from_found_effects(task, closed, opened)
    if opened is not None:
        opened = likelier_side(opened, options.max_iterations)
        note("all modes fitted")
    if opened is not None and (adjust_always or start_nm is None):
        declared, nominal = opened, nominal_of(task.frames, opened.problem, opened.x)
        wrong = adjustable and (adjust_always or opened.chi2_nu > nominal.most_behind_ao)
        found = _adjusted(task, closed, opened, adjustable, adjust_always) if wrong else None
        task, opened = found or (task, likelier_minimum(task, closed, opened, nominal.most))
        adjusted = opened.problem.model.effects.labels != declared.problem.model.effects.labels
        nominal = nominal if opened is declared else None
        note("facts of the instrument adjusted" if adjusted else "other explanations compared")
    twin, fit = scheme_of(options).twin(closed, options.law), opened or closed
    result = _result(frames, options, fit, twin, nominal if task.frames is frames else None)
    further = None
    if result.fit and result.errors_from == "frames" and result.nominal.excess(result.chi2_nu) > 0:
        further = uneven(frames, result.fit)
    if further is not None:
        note("the AO residual is uneven over the pupil: fitted again with it")
        if opened is None:
            fit = task.fit([*fit.problem.model.effects.effects, further], fit)
        else:
            fit = _with_one_more(task, opened, further)
        other = _result(frames, options, fit, twin)
        result = min(result, other, key=lambda one: one.chi2_nu)
    return replace(result, adjusted=adjusted, seconds=time.perf_counter() - began)


def _fit_steady(task: CubeFit, effects: Sequence[Effect]) -> Fit:
    """Fit with all effects; those whose position is unknown are searched for in what the others leave.

    Of several of one kind each is searched for jointly with those before it.
    """
    placed = {index: effect for index, effect in enumerate(effects) if not effect.needs_search}
    fit = task.fit(list(placed.values()))
    turns = occurrences(effect.name for effect in effects)
    for turn in sorted({turns[index] for index in range(len(effects)) if index not in placed}):
        now = [index for index in range(len(effects)) if index not in placed and turns[index] == turn]
        placed |= {index: best_start(fit.problem, fit.x, effects[index]) for index in now}
        fit = task.fit([placed[index] for index in sorted(placed)], fit)
    return fit


def _all_modes(task: CubeFit, effects: Sequence[Effect], fit: Fit) -> Opened | None:
    """The fit of all visible modes, where it is requested and possible."""
    if not task.options.open or any(isinstance(effect, HighOrderNcpa) for effect in effects):
        return None
    return _opened(task, fit.problem.model.effects.effects, fit)


def _opened(
    task: CubeFit, effects: Sequence[Effect], near: Fit, law: TailLaw | None = None, *, settle: bool = True
) -> Opened | None:
    """The fit of all modes with these effects, from one with some of them, `near`; see `open_basis`."""
    limit = task.options.max_iterations
    return open_basis(task.problem(effects), near, law=law, max_iterations=limit, settle=settle)


def _adjusted(
    task: CubeFit, closed: Fit, opened: Opened, adjustable: Sequence[Effect], always: bool
) -> tuple[CubeFit, Opened] | None:
    """The fit of all modes and what is `adjustable`, and the task with the weights that it has.

    What the model still misses, where that is not much, counts as an error of every pixel in proportion to
    its light, or the cores of bright stars would bend all that is free. Unless it is to be adopted `always`:
    None where much is missed, and the fit as declared where facts are not those of any instrument: other
    minima are not looked for then.
    """
    limit = task.options.max_iterations
    everywhere = [effect for effect in adjustable if not effect.copies_star]
    effects = opened.problem.model.effects.effects
    rough = _opened(task, [*effects, *everywhere], closed, settle=False)
    if rough is None:
        return None
    rough = likelier_side(rough, limit, settle=False)
    for image in (effect for effect in adjustable if effect.copies_star):
        rough = _with_second_image(task, rough, image)
    problem, x = rough.problem, rough.x
    nominal, chi2_nu = nominal_of(task.frames, problem, x), rough.chi2_nu
    if chi2_nu > nominal.most_behind_ao and not always:
        return None
    if not always and not all(fact.ordinary(values) for fact, values in facts_of(rough)):
        return task, opened
    if nominal.excess(chi2_nu) > 0 and chi2_nu <= nominal.most_behind_ao:

        def weighted(part: float) -> tuple[Frames, OpenFit]:
            frames = replace(task.frames, light_error=part)
            return frames, problem.reweighed(frames.root.to(problem.root_weight)[None, None])

        part = brentq(lambda part: float(weighted(part)[1].reduced_chi2(x)[0]) - nominal.value, 0.0, 1.0)
        frames, problem = weighted(part)
        task, rough = replace(task, frames=frames), replace(rough, problem=problem)
    return task, likelier_side(finished(rough, limit) or rough, limit)  # less is missing: sides show apart


def facts_of(fit: Fit) -> list[tuple[Effect, np.ndarray]]:
    """Return the facts of the instrument among the effects of a fit, and their values (parameters,)."""
    effects, own = fit.problem.model.effects, fit.problem.layout.effect_values
    found = zip(effects.effects, effects.pieces(fit.x[0, own]), strict=True)
    return [(one.base, one.all_values(free).numpy()) for one, free in found if one.base.fact]


def _with_second_image(task: CubeFit, rough: Opened, image: Effect) -> Opened:
    """A rough fit of all modes, or one with a second `image` that explains most of what it misses."""
    problem, x = rough.problem, rough.x
    nominal, chi2_nu = nominal_of(task.frames, problem, x), rough.chi2_nu
    if chi2_nu <= nominal.most:
        return rough
    other = _with_one_more(task, rough, best_start(problem, x, image), settle=False)
    return other if other.chi2_nu - nominal.value < EXPLAINED * (chi2_nu - nominal.value) else rough


def _with_one_more(task: CubeFit, opened: Opened, further: Effect, *, settle: bool = True) -> Opened:
    """The fit of all modes with a `further` effect, from where it is."""
    effects = [*opened.problem.model.effects.effects, further]
    return _opened(task, effects, opened, opened.law, settle=settle) or opened


def _from_found_effects(task: CubeFit, closed: Fit, opened: Opened) -> tuple[Fit, Opened]:
    """The likelier of two fits of all modes: from `closed`, which is `opened`, and from the effects as found.

    Jointly with few modes, or none, effects that a diagnosis found may diverge. Here they stay where it found
    them until the modes of the closed basis are fitted, and are free jointly with all modes only.
    """
    effects = closed.problem.model.effects.effects
    held = task.fit([effect.expected() if starts_as_told(effect) else effect for effect in effects])
    other = _opened(task, effects, held)
    if other is None or opened.objective <= other.objective:
        return closed, opened
    return held, other


def _explained_by_tail(task: CubeFit, effects: Sequence[Effect], fit: Fit) -> bool:
    """Whether modes beyond the closed basis are all that the model misses."""
    if fit.chi2_nu < MISFIT:
        return True
    opened = _all_modes(task, effects, fit)
    return opened is not None and opened.chi2_nu < MISFIT


def _weighted_by_misfit(task: CubeFit, effects: Sequence[Effect], fit: Fit) -> tuple[CubeFit, Fit]:
    """Fit a few frames again where the model misfits, so that noise and prior have their true weights.

    Weights of known noise alone would have modes follow what is no wavefront, against any prior.
    """
    for _ in range(MISFIT_ROUNDS):
        factor = fit.chi2_nu
        if factor < MISFIT:
            break
        task = replace(task, frames=replace(task.frames, misfit=task.frames.misfit * factor))
        fit = _fit_steady(task, effects)
    return task, fit


def _result(
    frames: Frames,
    options: CalibrationOptions,
    fit: Fit,
    twin: TwinCheck | None,
    nominal: NominalChi2 | None = None,
) -> Calibration:
    problem, settings, effects = fit.problem, fit.problem.model.psf.settings, METHODS[options.method].effects
    found = scheme_of(options).estimates(frames, fit)
    model = problem.predict(found.values)[0].reshape(settings.window).cpu()
    pull = ((frames.mean_e - model) / mean_variance_e2(frames).sqrt())[frames.good]
    chi2_nu = float((pull**2).sum() / (len(pull) - problem.layout.size))
    nominal = nominal or nominal_of(frames, problem, found.values)
    covariance_nm2, errors_from = errors_of(frames, fit, found.frames_nm, chi2_nu, nominal)
    return result_of(
        [frames],
        problem,
        found.values,
        model,
        options=options,
        zernike_nm=found.zernike_nm,
        covariance_nm2=covariance_nm2,
        errors_from=errors_from,
        frames_nm=found.frames_nm,
        frame_status=fit.solution.status,
        iterations=fit.solution.iterations.numpy(),
        chi2_nu=chi2_nu,
        nominal=nominal,
        twin=twin,
        tail=fit.law if isinstance(fit, Opened) else None,
        effects_sigma=effect_errors(frames, fit, chi2_nu / nominal.value),
        mirrored=mirrored(frames, problem, found.values) if effects else None,
        left_nominal=nominal_power(frames, problem, found.values, nominal),
        fit=fit if effects and settings.lenslets == 1 else None,
    )


def result_of(
    cubes: Sequence[Frames], part: ImageFit, x: torch.Tensor, model_e: torch.Tensor, **others: Any
) -> Calibration:
    """Return the result with what is stated of the frames, all `cubes` together, and of the first of these.

    Its fit is `part`, with the parameters `x` (1, parameters), and the model of its mean image `model_e`
    (rows, columns); the `others` are given.
    """
    first, layout, effects, settings = cubes[0], part.layout, part.model.effects, part.model.psf.settings
    values, sigma_e = x[0, layout.effect_values], mean_variance_e2(first).sqrt()
    left = torch.where(first.good, (first.mean_e - model_e) / sigma_e, torch.nan).numpy()
    longest_m = max(wavelength for wavelength, _ in settings.spectrum) * NM
    pixels = resolution_px(longest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)
    motions = [one.motion for one in cubes if one.motion is not None]
    kurtoses = map(kurtosis_of_frames, cubes)
    result = Calibration(
        nolls=layout.nolls,
        fitted_modes_nm=x[0, layout.modes].numpy(),
        effects=effects.describe(values),
        effect_values=effects.split(values),
        mean_image_e=first.mean_e.numpy(),
        model_image_e=model_e.numpy(),
        sigma_image_e=sigma_e.numpy(),
        noise_ratio=min((one.noise_ratio for one in cubes if len(one.images_e) > 1), default=math.nan),
        window_resolutions=min(settings.window) / pixels,
        kurtosis=min((kurtosis for kurtosis in kurtoses if math.isfinite(kurtosis)), default=math.nan),
        left=power_spectrum(left, settings.resolution_px),
        motion=max(motions, key=lambda one: one.largest_px, default=None),
        **others,
    )
    return _at_mean_place(result, first.motion, settings)


def _at_mean_place(result: Calibration, motion: Motion | None, settings: PsfSettings) -> Calibration:
    """Return the result with tip and tilt of the mean place of the star, whose `motion` was taken out.

    It was fitted where its first frames were steadied, up to half a pixel from there.
    """
    if motion is None:
        return result
    away_nm = tilt_nm(motion.displaced_px * settings.pixel_scale_mas, settings.geometry.diameter_m)
    names = ("zernike_nm", "fitted_modes_nm", "frames_nm", "covariance_nm2")
    whole_nm, modes_nm, frames_nm, covariance_nm2 = moved = [getattr(result, name).copy() for name in names]
    whole_nm[:2] += away_nm.mean(axis=0)
    modes_nm[:2] += away_nm.mean(axis=0)
    frames_nm[: len(away_nm), :2] += away_nm
    covariance_nm2[:2, :2] += covariance_of_mean(away_nm)
    return replace(result, **dict(zip(names, moved, strict=True)))


def drifts(effect: Effect) -> bool:
    """Return whether the effect is a change with time that is still to be estimated."""
    return effect.plane == "time" and len(effect.parameters) > 0


def starts_as_told(effect: Effect) -> bool:
    """Return whether the effect, one that not every recording has, starts from values found before."""
    if effect.usual or not isinstance(effect, FixedEffect) or not effect.free:
        return False
    return not np.array_equal(effect.values, effect.base.null_values)


def measured_drift(effect: Effect, nolls: Sequence[int], frames_nm: np.ndarray) -> FixedEffect:
    """Return the effect held at what the estimates of single frames show of it, by least squares.

    The mean image shows a drift to second order only, and not its sign; the frames show both. The `effect` is
    of the plane `time` and linear in its parameters, all of which are free; the modes `nolls` of `frames_nm`
    (frames, modes) are estimates at equal intervals of time. Raises ValueError if a mode that is to drift is
    not estimated.
    """
    when = torch.linspace(0, 1, len(frames_nm), dtype=torch.float64)
    still = torch.zeros(len(frames_nm), len(nolls), dtype=torch.float64)
    units = torch.eye(len(effect.base.parameters), dtype=torch.float64)
    courses = [effect.base.apply(unit, still, tuple(nolls), when) for unit in units]
    frames = torch.as_tensor(frames_nm)
    return FixedEffect(effect.base, [float((c * frames).sum() / c.square().sum()) for c in courses])
