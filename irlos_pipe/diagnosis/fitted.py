"""A model as a fit left it: its parameters, its images, and its effects to continue from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from irlos_pipe.diagnosis.joint_fit import JointFit
from irlos_pipe.diagnosis.view import View
from irlos_pipe.effects import Effect, FixedEffect, Parameter
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.solution import Solution


@dataclass(frozen=True)
class Fitted:
    """A model as a fit left it.

    Attributes
    ----------
    problem : JointFit
    solution : Solution
    chi2 : float
        Of the mean training images.
    views : sequence of View
        Of the recordings.
    """

    problem: JointFit
    solution: Solution
    chi2: float
    views: Sequence[View]

    @property
    def x(self) -> torch.Tensor:
        """All parameters, (1, parameters)."""
        return self.solution.values

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects of the model, in the order of the light path."""
        return self.problem.effects.effects

    @property
    def modes_nm(self) -> np.ndarray:
        """Zernike coefficients, (modes,)."""
        return self.x[0, self.problem.layout.modes].numpy()

    @property
    def effect_values(self) -> torch.Tensor:
        """Parameters of all effects, (parameters,)."""
        return self.x[0, self.problem.layout.effect_values]

    @property
    def recordings(self) -> list[tuple[ImageFit, torch.Tensor]]:
        """Problem and parameters (1, its parameters) of every recording by itself."""
        return [(part, self.problem.part(self.x, number)) for number, part in enumerate(self.problem.parts)]

    @cached_property
    def image_e(self) -> torch.Tensor:
        """Predicted mean images, (pixels,); those beside the derivatives, where these are known."""
        return self.linearised[0] if "linearised" in vars(self) else self.problem.predict(self.x)

    @cached_property
    def linearised(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean images (pixels,) and derivatives (parameters, pixels), which many ask for."""
        return self.problem.predict_and_jacobian(self.x)

    @property
    def penalty(self) -> float:
        """What the priors add to χ²."""
        offset = self.x - self.problem.prior_mean
        return float((self.problem.prior_precision * offset**2).sum())

    @property
    def converged(self) -> bool:
        """Whether the solver says so."""
        return bool(self.solution.converged[0])

    @property
    def exact(self) -> bool:
        """Whether it was fitted in float64."""
        return self.problem.model.psf.dtype == torch.float64

    def effect(self, label: str) -> Effect:
        """The effect with a `label`."""
        return self.effects[self.problem.effects.labels.index(label)]

    def values_of(self, label: str) -> np.ndarray:
        """All parameters of the effect with a `label`, fixed ones included."""
        free = self.problem.effects.split(self.effect_values)[label]
        return self.effect(label).all_values(free).numpy()

    def columns_of(self, label: str) -> list[int]:
        """Positions of the free parameters of the effect with a `label` in the whole parameter vector."""
        begin = self.problem.layout.effect_values.start
        return [begin + index for index in self.problem.effects.columns_of(label)]

    def continued(self) -> list[Effect]:
        """The effects with the same freedom, to start from where they are now."""
        return [*self.continued_by_label().values()]

    def continued_by_label(self) -> dict[str, Effect]:
        """The same by label, to leave one out or to put another in its place."""
        effects = self.problem.effects
        rows = zip(effects.labels, self.effects, effects.pieces(self.effect_values), strict=True)
        return {label: begun_at(effect, piece) for label, effect, piece in rows}

    def restarted(self) -> list[Effect]:
        """The effects with the same freedom, to start from where nothing is known of them."""
        return [begun_at(effect, [p.start for p in _free(effect)]) for effect in self.effects]


def begun_at(effect: Effect, values: Sequence[float] | np.ndarray) -> Effect:
    """The same effect with the same freedom, from other values of its free parameters.

    Parameters
    ----------
    effect : Effect
    values : ndarray, (free parameters,)
    """
    if not effect.parameters:
        return effect
    free = [parameter.name for parameter in effect.parameters]
    return FixedEffect(effect.base, effect.all_values(values).numpy(), free)


def _free(effect: Effect) -> list[Parameter]:
    """Free parameters as the effect itself declares them."""
    free = {parameter.name for parameter in effect.parameters}
    return [parameter for parameter in effect.base.parameters if parameter.name in free]
