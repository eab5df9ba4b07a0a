"""What is known about NCPAs before looking at the data."""

from __future__ import annotations

import torch

LAW_NM, LAW_DECAY, LAW_PLATEAU_NM = 70.0, 0.2, 10.0  # std(i) = A exp(-B i) + C, i = 0 for Noll 2
POINTING_NM = 5000.0  # tip and tilt: where the star lies in the window says nothing about the optics
FOCUS_NM = 400.0  # an uncontrolled focus bias is common


def ncpa_sigma_nm(nolls, scale: float) -> torch.Tensor:
    """Prior standard deviation of every mode [nm RMS]: the law of IRLOS's low-order NCPAs, widened.

    Parameters
    ----------
    nolls : sequence of int
    scale : float
        Factor on the law; above 1 the prior only steadies what the data do not determine.
    """
    index = torch.as_tensor(list(nolls), dtype=torch.float64) - 2
    sigma = scale * (LAW_NM * torch.exp(-LAW_DECAY * index) + LAW_PLATEAU_NM)
    sigma[index < 2] = POINTING_NM
    sigma[index == 2] = FOCUS_NM
    return sigma
