"""The prior of the NCPAs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.laws import NcpaLaw

POINTING_NM = 5000.0  # tip and tilt: where the star lies in the window says nothing about the optics
FOCUS_NM = 400.0  # an uncontrolled focus bias is common


@dataclass(frozen=True)
class NcpaPrior:
    """Gaussian prior of the modes about zero: the instrument's law of NCPAs, widened."""

    law: NcpaLaw
    scale: float  # factor on the law; above 1 the prior only steadies what the data do not determine

    def sigma_nm(self, nolls: Sequence[int]) -> torch.Tensor:
        """Standard deviation of every mode, (modes,) [nm RMS]; tip, tilt and focus are left almost free."""
        sigma = torch.as_tensor(self.scale * self.law.sigma_nm(nolls))
        noll = torch.as_tensor(list(nolls))
        sigma[noll < 4] = POINTING_NM
        sigma[noll == 4] = FOCUS_NM
        return sigma
