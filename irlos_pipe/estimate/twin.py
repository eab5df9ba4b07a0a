"""The twin solution: a centro-symmetric pupil gives φ(u) and −φ(−u) the same image.

Only the known diversity breaks the tie. With the diversity's own mode among the estimated
ones, the twin is an equally good fit whose even modes, diversity included, change sign; only what is
known of the size of aberrations, the instrument's law of NCPAs, separates them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.estimate.calibration_options import NcpaPrior
from irlos_pipe.estimate.image_fit import ModesFit
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.numerics.solution import Solution
from irlos_pipe.optics.zernike import noll_to_nm

DECISIVE = 10.0  # evidence from which a sign counts as known: odds of 150 to 1


@dataclass(frozen=True)
class TwinCheck:
    """Comparison of a solution with its twin."""

    delta_chi2: float  # χ² (prior included) of the refitted twin minus that of the solution
    rms_nm: float  # of the coefficients, tip and tilt left out
    twin_rms_nm: float
    distance_nm: float  # RMS difference between the two; near 0 when the twin fell back into the solution
    # χ² of the data, and of the coefficients under the instrument's law of NCPAs as it is, of the twin minus
    # that of the solution: -2 times the logarithm of the odds. The prior of the fit is wider than the law, so
    # that it does not bend the estimates; it would understate what the law says of a twin, which needs twice
    # the diversity as an aberration.
    evidence: float

    @property
    def preferred(self) -> str:
        """`solution`, `twin`, or `undecided` where neither data nor law decide."""
        if self.distance_nm < 1.0 or self.evidence > DECISIVE:
            return "solution"
        return "twin" if self.evidence < -DECISIVE else "undecided"


def twin_of(modes_nm: torch.Tensor, nolls: Sequence[int], known_nm: Mapping[int, float]) -> torch.Tensor:
    """Return the coefficients, (batch, modes), that give a centro-symmetric pupil the same image [nm].

    The known wavefront in the light path, `known_nm`, does not change.
    """
    twin = modes_nm.clone()
    for column, noll in enumerate(nolls):
        if noll_to_nm(noll)[0] % 2 == 0:
            twin[:, column] = -twin[:, column] - 2 * known_nm.get(noll, 0.0)
    return twin


def check_twin(
    problem: ModesFit,
    x: torch.Tensor,
    objective: float,
    law: NcpaLaw | None,
    known_nm: Mapping[int, float],
    max_iterations: int = 30,
) -> tuple[TwinCheck, Solution]:
    """Refit a problem from its twin and compare; returns the twin as well.

    The `problem` has one member, whose solution `x` (1, parameters) has this `objective`; `law` is that of
    the instrument's NCPAs, `known_nm` the known wavefront by Noll index.
    """
    modes, nolls = problem.layout.modes, problem.layout.nolls
    start = x.clone()
    start[:, modes] = twin_of(x[:, modes], nolls, known_nm)
    twin = solve(problem, start, max_iterations=max_iterations)
    shape = [i for i, noll in enumerate(nolls) if noll > 3]
    size = [float(v[0, shape].square().sum().sqrt()) for v in (x, twin.values, twin.values - x)]
    delta = 2 * float(twin.objective[0] - objective)
    by_data = delta - _square(twin.values, problem) + _square(x, problem)
    evidence = by_data + _law_square(twin.values, problem, law) - _law_square(x, problem, law)
    return TwinCheck(delta, size[0], size[1], size[2], evidence), twin


def _square(x: torch.Tensor, problem: ModesFit) -> float:
    """χ² of the parameters under the prior of the fit."""
    return float((problem.prior_precision[0] * (x[0] - problem.prior_mean[0]).square()).sum())


def _law_square(x: torch.Tensor, problem: ModesFit, law: NcpaLaw | None) -> float:
    """χ² of the coefficients under the instrument's law; 0 without one."""
    if law is None:
        return 0.0
    sigma_nm = NcpaPrior(law, 1.0).sigma_nm(problem.layout.nolls)
    return float((x[0, problem.layout.modes] / sigma_nm).square().sum())
