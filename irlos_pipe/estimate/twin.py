"""The twin solution: a centro-symmetric pupil gives φ(u) and −φ(−u) the same image.

Only the known diversity breaks the tie. With the diversity's own mode among the estimated
ones, the twin is an equally good fit whose even modes, diversity included, change sign; only the
prior and the size of the aberration that each would need separate them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.optics.zernike import noll_to_nm


@dataclass(frozen=True)
class TwinCheck:
    """Comparison of a solution with its twin.

    Attributes
    ----------
    delta_chi2 : float
        χ² (prior included) of the refitted twin minus that of the solution.
    rms_nm, twin_rms_nm : float
        RMS of the coefficients (tip and tilt left out) of the two.
    distance_nm : float
        RMS difference between the two; near 0 when the twin fell back into the solution.
    """

    delta_chi2: float
    rms_nm: float
    twin_rms_nm: float
    distance_nm: float

    @property
    def preferred(self) -> str:
        """`solution` if the twin fits worse or needs the larger aberration, else `twin`."""
        worse = self.delta_chi2 > 4.0 or self.twin_rms_nm >= self.rms_nm
        return "solution" if worse or self.distance_nm < 1.0 else "twin"


def twin_of(modes_nm: torch.Tensor, nolls: Sequence[int], known_nm: Mapping[int, float]) -> torch.Tensor:
    """Return the coefficients, (batch, modes), that give a centro-symmetric pupil the same image [nm].

    Parameters
    ----------
    modes_nm : tensor, (batch, modes)
    nolls : sequence of int
    known_nm : mapping of int to float
        The known wavefront in the light path, which does not change.
    """
    twin = modes_nm.clone()
    for column, noll in enumerate(nolls):
        if noll_to_nm(noll)[0] % 2 == 0:
            twin[:, column] = -twin[:, column] - 2 * known_nm.get(noll, 0.0)
    return twin


def check_twin(problem: ImageFit, x: torch.Tensor, objective: float) -> TwinCheck:
    """Refit the first member of a problem from its twin and compare.

    Parameters
    ----------
    problem : ImageFit
        With one member.
    x : tensor, (1, parameters)
        The solution found.
    objective : float
        Its objective.
    """
    modes, nolls = problem.layout.modes, problem.layout.nolls
    start = x.clone()
    start[:, modes] = twin_of(x[:, modes], nolls, problem.model.psf.settings.known.total_nm)
    twin = solve(problem, start, max_iterations=30)
    shape = [i for i, noll in enumerate(nolls) if noll > 3]
    size = [v[0, shape].square().sum().sqrt() for v in (x, twin.values, twin.values - x)]
    return TwinCheck(2 * float(twin.objective[0] - objective), *(float(s) for s in size))
