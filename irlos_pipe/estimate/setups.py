"""NCPA calibration from several set-ups: planes of known defocus, bands, filters, lenses, diversities.

The mean images of all set-ups are fitted together. The modes and the effects of the wavefront, among them
what depends on wavelength, filter and lens, are common; tip and tilt, flux and background belong to each
set-up, and the effects of star and sky to each source: planes of one recording show the same star.

Set-ups of few frames have the noise model and what their image misfits as their noise. What all of them
share, an error of the model, makes them contradict each other: the jackknife over set-ups says by how much
(Efron 1982, The Jackknife, the Bootstrap and Other Resampling Plans), and errors grow by it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Hashable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import torch

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import (
    MISFIT,
    MISFIT_ROUNDS,
    Calibration,
    SetupFit,
    calibrate,
    window_resolutions,
)
from irlos_pipe.estimate.calibration_errors import (
    ErrorsFrom,
    NominalChi2,
    Part,
    nominal_chi2_of,
    of_few_frames,
    public_errors,
    responses,
)
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames, covariance_of_mean, mean_variance_e2
from irlos_pipe.estimate.cube_fit import FIRST
from irlos_pipe.estimate.effect_modes import whole_wavefront
from irlos_pipe.estimate.image_fit import ImageFit, Layout, masked_variance
from irlos_pipe.estimate.methods import MEAN_IMAGE, start_at_centroids
from irlos_pipe.estimate.residual import kurtosis_of_frames
from irlos_pipe.estimate.twin import compared, twin_of
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.numerics.problem import CHI2_TOLERANCE, Problem
from irlos_pipe.numerics.solution import Solution
from irlos_pipe.optics.image_quality import power_spectrum
from irlos_pipe.optics.psf_settings import PsfSettings

POINTING = 2  # Noll 2 and 3, the first modes
FOCUSED = 3  # Noll 2 to 4
LEAST_SETUPS = 3  # set-ups from which they can contradict each other
UNDETERMINED = 0.5  # part of the prior's variance from which data determine nothing


@dataclass(frozen=True)
class Setup:
    """Frames that were taken in the same way.

    Attributes
    ----------
    common : sequence of Effect
        Those of the wavefront as they act here, in the same order in every set-up.
    own : sequence of Effect
        Those of star and sky.
    names : tuple of str
        Recordings of the frames. Set-ups of the same ones, planes, share star and sky.
    """

    frames: Frames
    settings: PsfSettings
    common: Sequence[Effect] = ()
    own: Sequence[Effect] = ()
    names: tuple[str, ...] = ()


def is_common(effect: Effect) -> bool:
    """Return whether an effect belongs to the wavefront or the instrument, and not to star and sky."""
    return effect.belongs_to == "instrument" and effect.instrumental


class SetupsFit(Problem):
    """Mean images of several set-ups by one vector; one member.

    Parameters
    ----------
    parts : sequence of ImageFit
        Their mean images, with the same modes.
    """

    def __init__(self, setups: Sequence[Setup], parts: Sequence[ImageFit]):
        self.parts = [part._with(has_prior=False, prior_precision=0 * part.prior_precision) for part in parts]
        place: dict[Hashable, int] = {}
        self.columns = [
            [place.setdefault(key, len(place)) for key in _keys(number, setup, part)]
            for number, (setup, part) in enumerate(zip(setups, parts, strict=True))
        ]
        self.size, self.layout, self.same_unit = len(place), parts[0].layout, parts[0].layout.modes
        good = sum(int((part.root_weight > 0).sum()) for part in parts)
        self.freedom = max(1, good - self.size)
        self.lower, self.upper = (
            self._spread([getattr(p, name) for p in parts]) for name in ("lower", "upper")
        )
        self.prior_mean, self.prior_precision = (
            self._spread([getattr(p, name)[0] for p in parts])[None]
            for name in ("prior_mean", "prior_precision")
        )

    def weighted(self, misfits: Sequence[float]) -> SetupsFit:
        """Return the same with the variance of each set-up's image larger by a factor."""
        other = copy(self)
        other.parts = [
            part._with(root_weight=part.root_weight * misfit**-0.5)
            for part, misfit in zip(self.parts, misfits, strict=True)
        ]
        return other

    def part_of(self, x: torch.Tensor, number: int) -> torch.Tensor:
        """Return the parameters of the set-up `number` out of the whole vector, (1, its parameters)."""
        return x[:, self.columns[number]]

    def whole(self, parts_x: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the whole vector from those of the set-ups; what they share is the first's, (1, size)."""
        return self._spread([x[0] for x in parts_x])[None]

    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        return CHI2_TOLERANCE * (2 * value / self.freedom).clamp_min(1.0)

    def objective(self, x: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        own = [part.objective(self.part_of(x, n), which) for n, part in enumerate(self.parts)]
        return torch.stack(own).sum(0) + self._prior(x)

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        value, gradient = self._prior(x), self.prior_precision * (x - self.prior_mean)
        hessian = torch.diag_embed(self.prior_precision)
        for number, (part, columns) in enumerate(zip(self.parts, self.columns, strict=True)):
            own_value, own_gradient, own_hessian = part.normal_equations(self.part_of(x, number), which)
            value, place = value + own_value, torch.tensor(columns)
            gradient[:, place] += own_gradient
            hessian[:, place[:, None], place] += own_hessian
        return value, gradient, hessian

    def _prior(self, x: torch.Tensor) -> torch.Tensor:
        return 0.5 * (self.prior_precision * (x - self.prior_mean) ** 2).sum(1)

    def _spread(self, of_parts: Sequence[torch.Tensor]) -> torch.Tensor:
        """One number per parameter of the set-ups as one vector."""
        spread = torch.zeros(self.size, dtype=torch.float64)
        for values, columns in reversed(list(zip(of_parts, self.columns, strict=True))):
            spread[columns] = values
        return spread


def _keys(number: int, setup: Setup, part: ImageFit) -> list[Hashable]:
    """What the parameters of a part are; those with the same key are one parameter."""
    keys: list[Hashable] = [
        ("mode", noll, number if index < POINTING else 0) for index, noll in enumerate(part.layout.nolls)
    ]
    common = {id(effect): index for index, effect in enumerate(setup.common)}
    source = setup.names or number
    own = {id(effect): index for index, effect in enumerate(setup.own)}
    for effect in part.model.effects.effects:
        at = ("common", common[id(effect)]) if id(effect) in common else ("own", source, own[id(effect)])
        keys += [(*at, index) for index in range(len(effect.parameters))]
    return [*keys, ("flux", number), ("background", number)]


def calibrate_setups(
    setups: Sequence[Setup],
    options: CalibrationOptions,
    *,
    device: str = "cpu",
    note: Callable[[str], None] | None = None,
) -> Calibration:
    """Estimate the static wavefront of recordings in several set-ups, in a closed basis.

    Window and pixel scale are the same in all `setups`; of the `options`, prior, number of modes and
    iterations count. The wavefront and its image are stated as the first
    set-up has it, with the standard errors of the effects; χ²/ν, its nominal value and the misfit by which
    errors grow are those of all together. `note` gets a line after every step.
    """
    began = time.perf_counter()
    closed = replace(options.resolved(), highest_noll=options.last_noll)
    parts = [_part(setup, closed, device) for setup in setups]
    plain = SetupsFit(setups, parts)

    def tell(step: str, at: Solution) -> None:
        if note is not None:
            note(f"{step}: chi2/nu {sum(_chi2(plain, at.values)) / plain.freedom:.2f}, {_since(began):.1f} s")

    solution = _from_none(setups, plain, closed, device)
    tell(f"{len(setups)} set-ups, Noll 2 to {closed.last_noll}", solution)
    problem, solution = _weighted_by_misfit(setups, plain, solution, closed.max_iterations)
    other = solve(problem, _twin_start(setups, problem, solution.values), max_iterations=30)
    if float(other.objective[0]) < float(solution.objective[0]):
        solution, other = other, solution
    twin = compared(problem, solution.values, float(solution.objective[0]), other, closed.law)
    tell("the likelier of that and its twin", solution)
    x = solution.values
    chi2_nu, nominal = sum(_chi2(plain, x)) / plain.freedom, _nominal(setups, problem, x)
    scatter, changes, errors_from = _errors(setups, problem, x, solution.covariance[0])
    left = sum(_chi2(problem, x)) / problem.freedom
    covariance = max(1.0, left / nominal.value, _contradiction(problem, x, scatter)) * scatter
    own, first = problem.part_of(x, 0), setups[0]
    layout, effects = parts[0].layout, parts[0].model.effects
    added, read = whole_wavefront(parts[0], own[0])
    values, columns = own[0, layout.effect_values], torch.tensor(problem.columns[0])
    mine = covariance[columns[:, None], columns]
    of_effects = mine[layout.effect_values, layout.effect_values]
    total = own[0, layout.modes] + added
    found = [
        _found(setup, part, problem.part_of(x, n), device)
        for n, (setup, part) in enumerate(zip(setups, problem.parts, strict=True))
    ]
    motions = [one.frames.motion for one in setups if one.frames.motion is not None]
    ratios = [one.frames.noise_ratio for one in setups if len(one.frames.images_e) > 1]
    residual = (found[0].mean_e - found[0].model_e) / found[0].sigma_e
    return Calibration(
        closed,
        layout.nolls,
        total.numpy(),
        own[0, layout.modes].numpy(),
        (read @ mine @ read.mT).numpy(),
        errors_from,
        effects.describe(values),
        effects.split(values),
        (total + changes[:, columns] @ read.mT).numpy(),
        solution.status,
        solution.iterations.numpy(),
        found[0].mean_e,
        found[0].model_e,
        found[0].sigma_e,
        chi2_nu,
        nominal,
        min(ratios, default=math.nan),
        window_resolutions(first.settings),
        kurtosis_of_frames(first.frames),
        twin,
        None,
        _since(began),
        public_errors(effects, values, of_effects.numpy()),
        power_spectrum(np.where(first.frames.good, residual, np.nan), first.settings.resolution_px),
        motion=max(motions, key=lambda one: one.largest_px, default=None),
        setups=found,
    )


def _since(began: float) -> float:
    return time.perf_counter() - began


def _chi2(problem: SetupsFit, x: torch.Tensor) -> list[float]:
    """χ² of the image of every set-up."""
    return [
        float(part.reduced_chi2(problem.part_of(x, n))[0]) * part.freedom
        for n, part in enumerate(problem.parts)
    ]


def _from_none(
    setups: Sequence[Setup], problem: SetupsFit, options: CalibrationOptions, device: str
) -> Solution:
    """The fit from no aberrations; and where it misfits, the better of that and one from the first set-up."""
    starts = [start_at_centroids(s.frames, p) for s, p in zip(setups, problem.parts, strict=True)]
    solution = solve(problem, problem.whole(starts), max_iterations=options.max_iterations)
    if (
        sum(_chi2(problem, solution.values))
        <= _nominal(setups, problem, solution.values).most * problem.freedom
    ):
        return solution
    alone = calibrate(setups[0].frames, setups[0].settings, options, setups[0].own, device=device)
    for number, start in enumerate(starts):
        known = slice(POINTING if number else 0, len(alone.nolls))
        start[:, known] = torch.as_tensor(alone.fitted_modes_nm[known])
    other = solve(problem, problem.whole(starts), max_iterations=options.max_iterations)
    return min(solution, other, key=lambda one: float(one.objective[0]))


def _weighted_by_misfit(
    setups: Sequence[Setup], plain: SetupsFit, solution: Solution, max_iterations: int
) -> tuple[SetupsFit, Solution]:
    """Fit again with what every image of few frames misfits as a part of its noise."""
    problem, misfits = plain, [1.0] * len(setups)
    for _ in range(MISFIT_ROUNDS):
        chi2 = zip(setups, plain.parts, _chi2(plain, solution.values), strict=True)
        now = [1.0 if s.frames.show_scatter else max(1.0, value / part.freedom) for s, part, value in chi2]
        if max(max(a / b, b / a) for a, b in zip(now, misfits, strict=True)) < MISFIT:
            break
        problem, misfits = plain.weighted(now), now
        solution = solve(problem, solution.values, max_iterations=max_iterations)
    return problem, solution


def _twin_start(setups: Sequence[Setup], problem: SetupsFit, x: torch.Tensor) -> torch.Tensor:
    """Where the twin begins that all set-ups like best, by the mean of what was introduced in them."""
    known = [setup.settings.known.total_nm for setup in setups]
    mean = {noll: sum(one.get(noll, 0.0) for one in known) / len(known) for one in known for noll in one}
    start = x.clone()
    start[:, problem.layout.modes] = twin_of(x[:, problem.layout.modes], problem.layout.nolls, mean)
    return start


def _found(setup: Setup, part: ImageFit, x: torch.Tensor, device: str) -> SetupFit:
    """What a set-up shows at the parameters `x` (1, its own), and what it says of its defocus by itself.

    All that is common is held. The defocus is looked for near the declared one and near that of the other
    sign: a plane whose sign is wrong would else stay where it is.
    """
    frames, settings, layout = setup.frames, setup.settings, part.layout
    beyond = dict(zip(layout.nolls[FOCUSED:], x[0, layout.modes].tolist()[FOCUSED:], strict=True))
    settings = replace(settings, known=replace(settings.known, ncpa_nm=beyond))
    psf = MEAN_IMAGE.psf_model(settings, layout.nolls[:FOCUSED], device)
    held = part.model.effects.held(x[0, layout.effect_values]).effects
    alone = ImageFit(ImageModel(psf, held), Layout(psf.nolls), part.images, part.root_weight.double() ** -2)
    near = x[:, [*range(FOCUSED), -2, -1]]
    mirrored = near.clone()
    mirrored[:, FOCUSED - 1] *= -1
    mirrored[:, FOCUSED - 1] -= 2 * settings.known.total_nm.get(DEFOCUS, 0.0)
    best = min(
        (solve(alone, start, max_iterations=30) for start in (near, mirrored)),
        key=lambda one: float(one.objective[0]),
    )
    grown = max(1.0, float(alone.reduced_chi2(best.values)[0])) ** 0.5
    variance = mean_variance_e2(frames)
    mean, model = frames.mean_e, part.predict(x)[0].reshape(settings.window).cpu()
    return SetupFit(
        ", ".join(setup.names),
        len(frames.images_e),
        settings.known.total_nm.get(DEFOCUS, 0.0),
        float(((mean - model).square() / variance)[frames.good].sum()) / part.freedom,
        float(best.values[0, FOCUSED - 1] - near[0, FOCUSED - 1]),
        float(best.sigma[0, FOCUSED - 1]) * grown,
        mean.numpy(),
        model.numpy(),
        variance.sqrt().numpy(),
    )


def _contradiction(problem: SetupsFit, x: torch.Tensor, covariance: torch.Tensor) -> float:
    """Variance of the common modes by the jackknife over set-ups, over their `covariance`; 0 of one or two.

    To first order the fit without set-up k is moved by ``(S - S_k)⁻¹ g_k``, with its gradient g_k and
    information S_k about what is common, its own parameters eliminated.
    """
    shared = sorted(set.intersection(*(set(columns) for columns in problem.columns)))
    modes = [n for n, column in enumerate(shared) if column < problem.layout.modes.stop]
    count = len(problem.parts)
    if count < LEAST_SETUPS or not modes:
        return 0.0
    slopes, information = [], []
    for number, (part, columns) in enumerate(zip(problem.parts, problem.columns, strict=True)):
        _, gradient, hessian = part.normal_equations(problem.part_of(x, number), FIRST)
        ours = [columns.index(column) for column in shared]
        rest = [n for n in range(len(columns)) if n not in ours]
        across = hessian[0][ours][:, rest] @ torch.linalg.pinv(hessian[0][rest][:, rest], hermitian=True)
        slopes.append(gradient[0, ours] - across @ gradient[0, rest])
        information.append(hessian[0][ours][:, ours] - across @ hessian[0][rest][:, ours])
    total = sum(information) + torch.diag(problem.prior_precision[0, shared])
    moved = torch.stack(
        [
            torch.linalg.pinv(total - own, hermitian=True) @ g
            for own, g in zip(information, slopes, strict=True)
        ]
    )
    jackknife = (count - 1) * moved.var(dim=0, correction=0)[modes]
    columns = torch.tensor(shared)[modes]
    determined = covariance.diagonal()[columns] * problem.prior_precision[0, columns] < UNDETERMINED
    ratio = (jackknife / covariance.diagonal()[columns])[determined]
    return float(ratio.mean()) if len(ratio) else 0.0


def _part(setup: Setup, options: CalibrationOptions, device: str) -> ImageFit:
    """The mean image of a set-up."""
    psf = MEAN_IMAGE.psf_model(setup.settings, range(2, options.last_noll + 1), device)
    model = ImageModel(psf, [*setup.common, *setup.own])
    sigma_nm = None if options.prior is None else options.prior.sigma_nm(psf.nolls)
    layout = Layout(psf.nolls, model.effects.parameters, prior_sigma_nm=sigma_nm)
    variance = masked_variance(mean_variance_e2(setup.frames), setup.frames.good)
    data = (one[None, None].flatten(-2).to(psf.device) for one in (setup.frames.mean_e, variance))
    return ImageFit(model, layout, *data)


def _nominal(setups: Sequence[Setup], problem: SetupsFit, x: torch.Tensor) -> NominalChi2:
    """χ²/ν of all mean images together about a model that lacks nothing."""
    parts = [
        Part(
            setup.frames,
            part.predict_and_jacobian(problem.part_of(x, number))[1][0],
            problem.columns[number],
        )
        for number, (setup, part) in enumerate(zip(setups, problem.parts, strict=True))
    ]
    return nominal_chi2_of(parts, problem.prior_precision[0])


def _errors(
    setups: Sequence[Setup], problem: SetupsFit, x: torch.Tensor, covariance: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, ErrorsFrom]:
    """Covariance of all parameters, the sum of what every set-up's noise makes of them, (size, size).

    It is that of the scatter of the frames, of few frames that of the weights. With it goes by how much each
    frame by itself would move the parameters, the mean of its set-up taken out, (frames, size), and where the
    errors are from.
    """
    total = covariance @ torch.diag(problem.prior_precision[0]) @ covariance
    changes, origins = [], set()
    for number, (setup, part) in enumerate(zip(setups, problem.parts, strict=True)):
        columns = problem.columns[number]
        _, jacobian = part.predict_and_jacobian(problem.part_of(x, number))
        weighted = jacobian[0].double().cpu() * part.root_weight[0].double().cpu().mean(0) ** 2
        series = responses(setup.frames, covariance[:, columns] @ weighted)
        if setup.frames.show_scatter:
            own, origin = torch.as_tensor(covariance_of_mean(series.numpy())), "frames"
        else:
            fisher = weighted @ jacobian[0].double().cpu().mT
            noise = (covariance[:, columns] @ fisher @ covariance[columns]).numpy()
            found, origin = of_few_frames(series.numpy(), noise)
            own = torch.as_tensor(found)
        total += own
        changes.append(series)
        origins.add(origin)
    worst = next(one for one in get_args(ErrorsFrom)[::-1] if one in origins)
    return total, torch.cat(changes), worst
