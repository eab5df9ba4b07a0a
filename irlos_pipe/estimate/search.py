"""Where to begin the fit of an effect whose position, direction or size is not known.

At the optimum of the model without the effect, the derivative of the images with respect to the effect's
size is the shape that it would add. The part d̃ of it that the fitted parameters cannot imitate, by
weighted least squares, meets the residual r: the size ``r·d̃ / d̃·d̃`` lowers χ² by ``(r·d̃)² / d̃·d̃``. The
candidate with the largest fall is where the fit begins; the last word has the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from irlos_pipe.effects import Effect, EffectSet, FixedEffect
from irlos_pipe.effects.base import OtfEffect, PupilEffect
from irlos_pipe.effects.effect_set import NOTHING
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.optics.grids import OtfGrid, PupilGrid

RIDGE = 1e-12  # of the diagonal of the normal matrix


@dataclass(frozen=True)
class Score:
    """What one candidate would do at the optimum without it.

    Attributes
    ----------
    candidate : Effect
    sizes : tensor, (parameters,)
        Linear estimate, within the bounds.
    gain : float
        Predicted fall of χ².
    survival : float
        Part of the power of the derivative that the other parameters cannot imitate, of its first parameter.
    """

    candidate: Effect
    sizes: torch.Tensor
    gain: float
    survival: float


def score(problem: ImageFit, x: torch.Tensor, candidate: Effect) -> Score:
    """Score of one candidate beside the effects that the problem has already.

    Parameters
    ----------
    problem : ImageFit
        One member; its layout holds the free parameters of its effects.
    x : tensor, (1, parameters)
        Its optimum.
    """
    return _Null(problem, x).score(candidate)


def best_start(problem: ImageFit, x: torch.Tensor, effect: Effect) -> FixedEffect:
    """The effect with all its parameters free, starting at its best candidate."""
    settings = problem.model.psf.settings
    null = _Null(problem, x)
    scores = [null.score(c) for c in effect.candidates(settings.window, settings.pixel_scale_mas)]
    best = max(scores, key=lambda one: one.gain)
    values = best.candidate.all_values(best.sizes).numpy()
    return FixedEffect(effect, values, free=[p.name for p in effect.parameters])


def located(problem: ImageFit, x: torch.Tensor, effects: Sequence[Effect]) -> list[Effect]:
    """Effects with a start for those that must be searched for; `problem` has those that need not."""
    return [best_start(problem, x, effect) if effect.needs_search else effect for effect in effects]


class _Null:
    """The optimum without the candidates: residual, and derivatives made orthonormal."""

    def __init__(self, problem: ImageFit, x: torch.Tensor):
        self.problem, self.x = problem, x
        image, columns = problem.predict_and_jacobian(x)
        self.root = problem.root_weight[0].double().square().mean(0).sqrt()
        self.residual = (problem.images[0].double().mean(0) - image[0]) * self.root
        self.basis = torch.linalg.qr((columns[0].double() * self.root).mT)[0]  # (pixels, parameters)
        self.own = frozen(problem.model.effects, x[0, problem.layout.effect_values])

    def score(self, candidate: Effect) -> Score:
        """See `score`."""
        shapes = self._shapes(candidate)
        rest = shapes - self.basis @ (self.basis.mT @ shapes)
        normal = rest.mT @ rest
        ridge = RIDGE * torch.diag((shapes**2).sum(0))
        sizes = torch.linalg.solve(normal + ridge, rest.mT @ self.residual)
        sizes = _within(candidate, sizes)
        fall = 2 * sizes @ (rest.mT @ self.residual) - sizes @ normal @ sizes
        return Score(candidate, sizes.cpu(), float(fall), float(normal[0, 0] / (shapes[:, 0] ** 2).sum()))

    def _shapes(self, candidate: Effect) -> torch.Tensor:
        """Whitened derivatives with respect to the candidate's parameters at their null values."""
        whole = ImageModel(self.problem.model.psf, [*self.own, candidate])
        null = torch.tensor(candidate.null_values, dtype=torch.float64)
        at = self.x[:, self.problem.layout.modes], self.x[:, -2], self.x[:, -1], null
        columns = whole.predict_and_jacobian(*at, modal=False)[1][0].double().flatten(1)
        return (columns[:-2] * self.root).mT


class _FrozenTransfer(OtfEffect):
    """OTF factors that do not change while candidates are tried, computed once."""

    name = "frozen"
    parameters = ()

    def __init__(self, factor: torch.Tensor):
        self.factor = factor

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.apply`."""
        return factor * self.factor


class _FrozenPupil(PupilEffect):
    """An effect in the pupil that does not change, as what it multiplies the field by and what it adds."""

    name = "frozen"
    parameters = ()

    def __init__(self, effect: FixedEffect, grid: PupilGrid):
        dark = torch.zeros(len(grid.wavelengths_m), *grid.amplitude.shape, dtype=torch.complex128)
        self.order = effect.order
        self.added = effect.apply(NOTHING, dark, grid)
        self.factor = effect.apply(NOTHING, dark + 1, grid) - self.added

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """See `PupilEffect.apply`."""
        return field * self.factor + self.added


def frozen(effects: EffectSet, values: torch.Tensor) -> list[Effect]:
    """The effects held at `values`, computed once; all as they are where wavelengths may move."""
    held = effects.held(values)
    if held.at("sampling"):
        return list(held.effects)
    grids = held.grids
    grid = grids.pupil.at(grids.sampling.wavelengths_m)
    fixed = [effect for effect in held.effects if effect.plane not in ("pupil", "otf")]
    fixed += [_FrozenPupil(effect, grid) for effect, _ in held.at("pupil")]
    return [*fixed, _FrozenTransfer(held().transfer)] if held.at("otf") else fixed


def _within(candidate: Effect, sizes: torch.Tensor) -> torch.Tensor:
    """Null values plus sizes, kept within the bounds."""
    limits = torch.tensor([[p.lower, p.upper] for p in candidate.parameters], dtype=torch.float64)
    null = torch.tensor(candidate.null_values, dtype=torch.float64)
    return (null + sizes.cpu()).clamp(limits[:, 0], limits[:, 1]).to(sizes.device)
