"""NCPA calibration from recordings in several set-ups: bands, filters, lenses, diversities.

The mean images of all set-ups are fitted together. The modes and the effects of the wavefront, among them
what depends on wavelength, filter and lens, are common; tip and tilt, flux, background, and the effects of
star and sky belong to each set-up.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import torch

from irlos_pipe.effects import Effect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_errors import (
    NominalChi2,
    Part,
    nominal_chi2_of,
    public_errors,
    responses,
)
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames, covariance_of_mean, mean_variance_e2
from irlos_pipe.estimate.effect_modes import whole_wavefront
from irlos_pipe.estimate.image_fit import ImageFit, Layout, masked_variance
from irlos_pipe.estimate.methods import MEAN_IMAGE, start_at_centroids
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.numerics.problem import CHI2_TOLERANCE, Problem
from irlos_pipe.optics.psf_settings import PsfSettings

POINTING = 2  # Noll 2 and 3, the first modes


@dataclass(frozen=True)
class Setup:
    """Frames that were taken in the same way.

    Attributes
    ----------
    common : sequence of Effect
        Those of the wavefront as they act here, in the same order in every set-up.
    own : sequence of Effect
        Those of star and sky.
    """

    frames: Frames
    settings: PsfSettings
    common: Sequence[Effect] = ()
    own: Sequence[Effect] = ()


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
        self.size, self.same_unit = len(place), parts[0].layout.modes
        good = sum(int((part.root_weight > 0).sum()) for part in parts)
        self.freedom = max(1, good - self.size)
        self.lower, self.upper = (
            self._spread([getattr(p, name) for p in parts]) for name in ("lower", "upper")
        )
        self.prior_mean, self.prior_precision = (
            self._spread([getattr(p, name)[0] for p in parts]) for name in ("prior_mean", "prior_precision")
        )

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
        hessian = torch.diag(self.prior_precision)[None].clone()
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
    own = {id(effect): index for index, effect in enumerate(setup.own)}
    for effect in part.model.effects.effects:
        at = ("common", common[id(effect)]) if id(effect) in common else ("own", number, own[id(effect)])
        keys += [(*at, index) for index in range(len(effect.parameters))]
    return [*keys, ("flux", number), ("background", number)]


def calibrate_setups(
    setups: Sequence[Setup], options: CalibrationOptions, *, device: str = "cpu"
) -> Calibration:
    """Estimate the static wavefront of recordings in several set-ups, in a closed basis.

    Window and pixel scale are the same in all `setups`; of the `options`, prior, number of modes and
    iterations count. The wavefront is stated as the first set-up has it, with the standard errors of the
    effects; χ²/ν, its nominal value and the misfit by which errors grow are those of all together.
    """
    began = time.perf_counter()
    first = setups[0]
    closed = replace(options.resolved(), highest_noll=options.last_noll)
    alone = calibrate(first.frames, first.settings, closed, first.own, device=device)
    parts = [_part(setup, closed, device) for setup in setups]
    problem = SetupsFit(setups, parts)
    starts = [start_at_centroids(s.frames, p) for s, p in zip(setups, parts, strict=True)]
    for number, start in enumerate(starts):
        known = slice(POINTING if number else 0, len(alone.nolls))
        start[:, known] = torch.as_tensor(alone.fitted_modes_nm[known])
    solution = solve(problem, problem.whole(starts), max_iterations=options.max_iterations)
    x = solution.values
    chi2 = [float(p.reduced_chi2(problem.part_of(x, n))[0]) * p.freedom for n, p in enumerate(problem.parts)]
    chi2_nu, nominal = sum(chi2) / problem.freedom, _nominal(setups, problem, x)
    scatter, frames_nm = _errors(setups, problem, x, solution.covariance[0])
    covariance = max(1.0, chi2_nu / nominal.value) * scatter
    own = problem.part_of(x, 0)
    layout, effects = parts[0].layout, parts[0].model.effects
    added, read = whole_wavefront(parts[0], own[0])
    values = own[0, layout.effect_values]
    columns = torch.tensor(problem.columns[0])
    mine = covariance[columns[:, None], columns]
    of_effects = mine[layout.effect_values, layout.effect_values]
    total = own[0, layout.modes] + added
    return replace(
        alone,
        options=closed,
        zernike_nm=total.numpy(),
        fitted_modes_nm=own[0, layout.modes].numpy(),
        covariance_nm2=(read @ mine @ read.mT).numpy(),
        errors_from="frames",
        effects=effects.describe(values),
        effects_sigma=public_errors(effects, values, of_effects.numpy()),
        effect_values=effects.split(values),
        frames_nm=(total + frames_nm[:, columns] @ read.mT).numpy(),
        frame_status=solution.status,
        iterations=solution.iterations.numpy(),
        model_image_e=parts[0].predict(own)[0].reshape(first.settings.window).cpu().numpy(),
        chi2_nu=chi2_nu,
        nominal=nominal,
        tail=None,
        seconds=time.perf_counter() - began,
    )


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
    return nominal_chi2_of(parts, problem.prior_precision)


def _errors(
    setups: Sequence[Setup], problem: SetupsFit, x: torch.Tensor, covariance: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Covariance of all parameters from the scatter of the frames of every set-up, and that of the first's.

    The latter is by how much each frame of the first set-up by itself would move the parameters, their mean
    taken out, (frames of the first set-up, size); the covariance is (size, size).
    """
    total, changes = torch.zeros_like(covariance), []
    for number, (setup, part) in enumerate(zip(setups, problem.parts, strict=True)):
        _, jacobian = part.predict_and_jacobian(problem.part_of(x, number))
        weight = part.root_weight[0].double().mean(0) ** 2
        gain = covariance[:, problem.columns[number]] @ (jacobian[0].double() * weight).cpu()
        series = responses(setup.frames, gain)
        total += torch.as_tensor(covariance_of_mean(series.numpy()))
        changes.append(series)
    return total, changes[0]
