"""One wavefront and one set of effects fitted to the mean images of several recordings, and what a fit left.

Tip, tilt, flux and background are those of each recording. Recordings of other moments, of another star or
night, have effects of their own, and a wavefront that differs from the common one by a drift: small changes
of every mode with a Gaussian prior. The parameter vector is that of the first recording with the drifts and
the other recordings' own numbers between the effects and its flux and background.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.diagnosis.options import DRIFT_NM
from irlos_pipe.diagnosis.view import View
from irlos_pipe.effects import Effect, FixedEffect, Parameter
from irlos_pipe.effects.effect_set import EffectSet
from irlos_pipe.estimate.image_fit import ImageFit, JoinedFit
from irlos_pipe.numerics.problem import CHI2_TOLERANCE, CheapGradientProblem
from irlos_pipe.numerics.solution import Solution


@dataclass(frozen=True)
class Fitted:
    """A model as a fit left it."""

    problem: JointFit
    solution: Solution
    chi2: float  # of the mean training images
    views: Sequence[View]  # of the recordings
    complete: bool = False  # whether its covariance holds all errors of the mean images, speckles' as well

    @property
    def x(self) -> torch.Tensor:
        """All parameters, (1, parameters)."""
        return self.solution.values

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects of the model, in the order of the light path."""
        return self.problem.effects.effects

    def moved(self, by: torch.Tensor) -> Fitted:
        """The model with other parameters, nothing fitted."""
        return Fitted(self.problem, replace(self.solution, values=self.x + by), self.chi2, self.views)

    def with_wavefront(self, zernike_nm: Mapping[int, float]) -> Fitted:
        """The model with another wavefront, Noll index to nm RMS, where it is known; it points as it did."""
        x = self.x.clone()
        for place, noll in enumerate(self.problem.layout.nolls):
            if noll not in TIP_TILT:
                x[0, place] = zernike_nm.get(noll, 0.0)
        return replace(self, solution=replace(self.solution, values=x))

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
        """Predicted mean images, (pixels,); those that came with the derivatives, where these are known."""
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
    def explored(self) -> bool:
        """Whether it was fitted to a loose tolerance only."""
        return self.problem.tolerance > CHI2_TOLERANCE

    def effect(self, label: str) -> Effect:
        return self.effects[self.problem.effects.labels.index(label)]

    def values_of(self, label: str) -> np.ndarray:
        """All parameters of the effect, fixed ones included."""
        free = self.problem.effects.split(self.effect_values)[label]
        return self.effect(label).all_values(free).numpy()

    def columns_of(self, label: str) -> list[int]:
        """Positions of the effect's free parameters in the whole parameter vector."""
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


def begun_at(effect: Effect, values: Sequence[float] | np.ndarray) -> Effect:
    """The same effect with the same freedom, from other `values` of its free parameters."""
    if not effect.parameters:
        return effect
    free = [parameter.name for parameter in effect.parameters]
    return FixedEffect(effect.base, effect.all_values(values).numpy(), free)


def _free(effect: Effect) -> list[Parameter]:
    """Free parameters as the effect itself declares them."""
    free = {parameter.name for parameter in effect.parameters}
    return [parameter for parameter in effect.base.parameters if parameter.name in free]


OWN = 4  # tip, tilt, flux and background of each recording
POINTING = 2  # modes that belong to each recording, tip and tilt


class JointFit(CheapGradientProblem, JoinedFit):
    """Least-squares problem for the solver; one member.

    Of the `parts`, one per recording, all have the same modes, Noll 2 and 3 first, and those effects that act
    in them; `effects` are all, by default those of the first recording. Unless `moments` says the moment of
    each recording, it is the same. `drift_nm` is the prior σ of the change of every mode from the common
    wavefront to that of a moment, of no use with one moment. The fit is done where the fall of χ² still ahead
    is below `tolerance`, in units of χ²/ν where the model misfits.
    """

    def __init__(
        self,
        parts: Sequence[ImageFit],
        effects: EffectSet | None = None,
        moments: Sequence[int] = (),
        drift_nm: float = DRIFT_NM,
        tolerance: float = CHI2_TOLERANCE,
    ):
        self.model = parts[0].model
        self.effects = self.model.effects if effects is None else effects
        self.moments = tuple(moments) or (0,) * len(parts)
        layout = replace(parts[0].layout, effects=self.effects.parameters)
        shared, modes = layout.size - 2, len(layout.nolls)
        drifting = sorted({*self.moments}) if len({*self.moments}) > 1 else []
        starts = (shared + number * (modes - POINTING) for number in range(len(drifting)))
        self.drifts = {
            moment: list(range(begin, begin + modes - POINTING))
            for moment, begin in zip(drifting, starts, strict=True)
        }
        begin_own = shared + len(drifting) * (modes - POINTING)
        last = begin_own + OWN * (len(parts) - 1)
        columns = []
        for number, moment in enumerate(self.moments):
            begin = begin_own + OWN * (number - 1)
            tip, tilt, flux, background = range(begin, begin + OWN) if number else (0, 1, last, last + 1)
            acting = [modes + column for column in self.effects.columns_in(moment)]
            columns.append([tip, tilt, *range(POINTING, modes), *acting, flux, background])
        changes = [dict(enumerate(self.drifts.get(moment, ()), POINTING)) for moment in self.moments]
        sigma = {column: drift_nm for columns in self.drifts.values() for column in columns}
        super().__init__(parts, columns, changes, sigma, tolerance)
        self.layout = layout
        ends = torch.tensor([0, *(part.images.shape[-1] for part in parts)]).cumsum(0).tolist()
        self.pixels = [slice(a, b) for a, b in pairwise(ends)]

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns, the same in all recordings."""
        return self.model.psf.settings.window

    @property
    def of_recordings(self) -> list[int]:
        """Columns of what belongs to single recordings, four after the other for each."""
        return [column for number in range(len(self.parts)) for column in self.own_of(number)]

    def own_of(self, number: int) -> list[int]:
        """Columns of tip, tilt, flux and background of recording `number`."""
        return [self.own[number][i] for i in (0, 1, -2, -1)]

    @property
    def tail(self) -> int:
        """Number of parameters behind the effects."""
        return self.size - self.layout.effect_values.stop

    # -- images ------------------------------------------------------------------------------

    def predict(self, x: torch.Tensor) -> torch.Tensor:
        """Mean images of all recordings [e-], one after the other, (pixels,)."""
        pairs = enumerate(self.parts)
        return torch.cat([part.predict(self.part(x, number))[0].cpu() for number, part in pairs])

    def predict_and_jacobian(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean images (pixels,) and derivatives (parameters, pixels)."""
        images, jacobian = [], torch.zeros(self.size, self.pixels[-1].stop, dtype=torch.float64)
        for number, part in enumerate(self.parts):
            image, own = part.predict_and_jacobian(self.part(x, number))
            images.append(image[0].cpu())
            jacobian[self.columns[number], self.pixels[number]] = own[0].cpu().double()[self.rows[number]]
        return torch.cat(images), jacobian

    @torch.no_grad()
    def chi2(self, x: torch.Tensor) -> torch.Tensor:
        """χ² of all mean images at `x`."""
        left = (part.reduced_chi2(self.part(x, n))[0] * part.freedom for n, part in enumerate(self.parts))
        return torch.stack(list(left)).sum()
