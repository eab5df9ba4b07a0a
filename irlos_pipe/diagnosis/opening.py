"""All modes that the window shows, fitted jointly with the effects of a model.

Many modes imitate whatever is small and bright. Their prior, whose law is fitted, says how much of it they
may: an effect that they would rather not imitate lowers χ² and prior together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.fitted import Fitted, JointFit
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.open_fit import TailLaw, open_basis


@dataclass(frozen=True)
class Opening:
    """A fit of all visible modes of one recording."""

    fitted: Fitted  # all modes free, those beyond the closed basis with the law that was fitted
    closed: Fitted  # the problem of the closed basis, without the others, from which it began
    law: TailLaw  # of the modes beyond the closed basis

    @classmethod
    def of(
        cls,
        fitter: Fitter,
        effects: Sequence[Effect],
        near: Fitted,
        beyond_nm: Mapping[int, float],
        law: TailLaw | None = None,
    ) -> Opening | None:
        """Fit all modes jointly with some effects; None of several recordings, or where it cannot be made.

        The light paths of the `fitter` have none of the modes beyond the closed basis. That begins `near` a
        fit, the modes beyond at `beyond_nm`, Noll index to nm RMS; for `law` see `open_basis`.
        """
        if len(fitter.views) > 1:
            return None
        closed = fitter.begun(effects, near)
        try:
            part, values = closed.problem.parts[0], closed.solution.values
            opened = open_basis(part, values, beyond_nm=beyond_nm, law=law)
        except (ValueError, np.linalg.LinAlgError):
            return None
        if opened is None or not bool(opened.solution.values.isfinite().all()):
            return None
        problem = JointFit([opened.problem])
        chi2 = float(problem.chi2(opened.solution.values))
        return cls(Fitted(problem, opened.solution, chi2, fitter.views), closed, opened.law)

    @property
    def beyond_nm(self) -> dict[int, float]:
        """The modes beyond the closed basis; Noll index to nm RMS."""
        nolls = self.fitted.problem.layout.nolls
        first = len(self.closed.problem.layout.nolls)
        return dict(zip(nolls[first:], self.fitted.x[0, first : len(nolls)].tolist(), strict=True))

    def deviance(self, misfit: float = 1.0) -> float:
        """Twice the negative logarithm of its likelihood and priors, whatever part of χ² the model misses.

        Variances allow for the χ²/ν of an earlier model, `misfit`. What a better one misses is less, but
        never less than noise, so that the factor on the variances is that with which χ²/ν is one:
        ``ν ln s + χ²/s`` plus the priors, ``s = max(χ²/ν, 1 / misfit)``.
        """
        freedom, chi2 = self.fitted.problem.freedom, self.fitted.chi2
        scale = max(chi2 / freedom, 1 / misfit)
        return freedom * float(np.log(scale)) + chi2 / scale + self.fitted.penalty

    def optimum(self, stack: Stacks) -> Optimum:
        """The residual, for score tests jointly with all modes."""
        return Optimum(stack, self.fitted)

    def with_known_modes(self) -> Fitted:
        """The closed basis where this fit has it, the modes beyond it known."""
        views = [view.with_known(self.beyond_nm) for view in self.fitted.views]
        x, first, modes = (
            self.fitted.x,
            len(self.closed.problem.layout.nolls),
            self.fitted.problem.layout.modes,
        )
        values = torch.cat([x[:, :first], x[:, modes.stop :]], dim=1)
        solution = replace(self.closed.solution, values=values)
        return replace(self.closed, solution=solution, views=views)
