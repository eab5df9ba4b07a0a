"""Standard deviation per mode (paper, appendix A): many modes estimated on cubes with 50 simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.paper.common.cube import CubeSample, ObservedCube
from irlos_pipe.paper.common.variants import Variant

INTRODUCED = 51  # highest Noll mode of the simulated NCPAs
FIRST_FITTED = 4  # tip and tilt hold the residual image motion of a finite cube


@dataclass(frozen=True)
class StatisticsSample:
    """One cube and how it is calibrated.

    Attributes
    ----------
    highest_noll : int
        Modes Noll 2 to this are estimated.
    frames : mapping of str to int
        Frames that a method is given.
    """

    cube: CubeSample
    highest_noll: int
    frames: Mapping[str, int]

    @property
    def name(self) -> str:
        """Return the name of the cube."""
        return self.cube.name


def estimate_modes(sample: StatisticsSample) -> dict[str, np.ndarray]:
    """Simulate a cube and estimate many modes, without a prior.

    Returns
    -------
    dict of str to ndarray
        ``introduced_nm`` and for every method ``<method>/zernike_nm`` and ``/sigma_nm``, (modes,) each,
        Noll 2 to `highest_noll`; ``<method>/chi2_nu``.
    """
    cube = ObservedCube.of(sample.cube.scene())
    nolls = range(2, sample.highest_noll + 1)
    numbers = {"introduced_nm": np.array([cube.scene.ncpa_nm.get(noll, 0.0) for noll in nolls])}
    for method, count in sample.frames.items():
        options = CalibrationOptions(method, highest_noll=sample.highest_noll)
        calibration = cube.first(count).calibrated(Variant(method, options, prior=False))
        numbers |= {
            f"{method}/zernike_nm": calibration.zernike_nm,
            f"{method}/sigma_nm": calibration.sigma_nm,
            f"{method}/chi2_nu": np.array(calibration.chi2_nu),
        }
    return numbers


def beyond_nm(nolls: np.ndarray, std_nm: np.ndarray) -> float:
    """Return the RMS of the standard deviations `std_nm` of those `nolls` that were not introduced [nm].

    It is the cross-talk and noise per mode.
    """
    return float(np.sqrt(np.mean(std_nm[nolls > INTRODUCED] ** 2)))
