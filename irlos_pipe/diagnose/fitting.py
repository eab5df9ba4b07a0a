"""Fits of the mean training image with one set of effects or another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..effects import Effect, Pinned
from ..estimate.centring import start_tilts_nm
from ..estimate.image_fit import ImageFit
from ..estimate.parameters import Layout
from ..estimate.priors import ncpa_sigma_nm
from ..estimate.solve import Solution, solve
from ..estimate.twin import twin_of
from ..image_model import ImageModel
from ..psf import PsfModel
from .cube import Stack

PRIOR_SCALE = 3.0  # over the law of the NCPAs
MAX_ITERATIONS = 30


@dataclass(frozen=True)
class Fitted:
    """A model at its optimum.

    Attributes
    ----------
    problem : ImageFit
    solution : Solution
    chi2 : float
        Of the mean training image.
    """

    problem: ImageFit
    solution: Solution
    chi2: float

    @property
    def x(self) -> torch.Tensor:
        """All parameters, (1, parameters)."""
        return self.solution.values

    @property
    def effects(self) -> tuple[Effect | Pinned, ...]:
        """Of the model, in the order of the light path."""
        return self.problem.model.effects.effects

    @property
    def modes_nm(self) -> np.ndarray:
        """Zernike coefficients, (modes,)."""
        return self.x[0, self.problem.layout.modes].numpy()

    @property
    def effect_values(self) -> torch.Tensor:
        """Parameters of the effects, (parameters,)."""
        return self.x[0, self.problem.layout.effect_values]

    @property
    def image_e(self) -> torch.Tensor:
        """Predicted mean image, (pixels,)."""
        return self.problem.predict(self.x)[0].cpu()

    @property
    def converged(self) -> bool:
        """Whether the solver says so."""
        return bool(self.solution.converged[0])

    def values_of(self, name: str) -> np.ndarray:
        """Parameters of one effect."""
        return self.problem.model.effects.split(self.effect_values)[name]

    def continued(self) -> list[Effect | Pinned]:
        """The effects with the same freedom, to start from where they are now."""
        pieces = self.problem.model.effects.split(self.effect_values)
        return [_from_here(effect, pieces[effect.name]) for effect in self.effects]


def _from_here(effect: Effect | Pinned, values: np.ndarray) -> Effect | Pinned:
    if not effect.parameters:
        return effect
    bare = effect.effect if isinstance(effect, Pinned) else effect
    full = effect.all_values(values).numpy() if isinstance(effect, Pinned) else values
    return Pinned(bare, full, free=[p.name for p in effect.parameters])


class Fitter:
    """Fits one mean image with any effects.

    Parameters
    ----------
    psf : PsfModel
        In float64: the mean image is more precise than float32.
    stack : Stack
    """

    def __init__(self, psf: PsfModel, stack: Stack):
        self.psf, self.stack = psf, stack

    def fit(self, effects: Sequence[Effect | Pinned], near: Fitted | None = None) -> Fitted:
        """Fit from zero wavefront, or from modes, flux and background of another fit."""
        problem = self._problem(effects)
        return self._solved(problem, self._start(problem, near))

    def twin(self, fitted: Fitted) -> Fitted:
        """The fit that starts from the twin of another one, (φ(u) → −φ(−u))."""
        problem, start = fitted.problem, fitted.x.clone()
        modes = problem.layout.modes
        start[:, modes] = twin_of(start[:, modes], self.psf.nolls, self.psf.settings.diversity)
        return self._solved(problem, start)

    def _problem(self, effects: Sequence[Effect | Pinned]) -> ImageFit:
        model = ImageModel(self.psf, effects)
        prior = ncpa_sigma_nm(self.psf.nolls, PRIOR_SCALE)
        layout = Layout(self.psf.nolls, model.effects.parameters, prior_sigma_nm=prior)
        stack, device = self.stack, self.psf.device
        return ImageFit(
            model, layout, stack.mean_e[None, None].to(device), stack.variance_e2[None, None].to(device)
        )

    def _start(self, problem: ImageFit, near: Fitted | None) -> torch.Tensor:
        masked = self.stack.mean_e * (self.stack.root > 0)
        x = problem.layout.start(masked[None])
        if near is None:
            settings = self.psf.settings
            image = masked.reshape(1, *settings.window)
            x[:, :2] = start_tilts_nm(image, settings.pixel_scale_mas, settings.geometry.diameter_m)
            return x
        x[:, problem.layout.modes], x[:, -2:] = near.x[:, near.problem.layout.modes], near.x[:, -2:]
        return x

    def _solved(self, problem: ImageFit, start: torch.Tensor) -> Fitted:
        solution = solve(problem, start, max_iterations=MAX_ITERATIONS)
        return Fitted(problem, solution, float(problem.reduced_chi2(solution.values)[0] * problem.freedom))
