"""Standard deviation per mode (paper, appendix A): many modes estimated on cubes with 50 simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.estimate.calibration import CalibrationOptions, calibrate
from irlos_pipe.paper.common.observation import frames_of, model_effects_of, settings_of
from irlos_pipe.paper.methods.experiment import Sample, scene_of
from irlos_pipe.simulate.exposure import expose

INTRODUCED = 51  # highest Noll mode of the simulated NCPAs
FIRST_FITTED = 4  # tip and tilt hold the residual image motion of a finite cube


@dataclass(frozen=True)
class StatisticsSample:
    """One cube and how it is calibrated.

    Attributes
    ----------
    cube : Sample
        Its `variants` are not used.
    highest_noll : int
        Modes Noll 2 to this are estimated.
    frames : mapping of str to int
        Frames that a method is given.
    """

    name: str
    cube: Sample
    highest_noll: int
    frames: Mapping[str, int]


def estimate_modes(sample: StatisticsSample) -> dict[str, np.ndarray]:
    """Simulate a cube and estimate many modes, without a prior.

    Returns
    -------
    dict of str to ndarray
        ``introduced_nm`` and for every method ``<method>/zernike_nm`` and ``/sigma_nm``, (modes,) each,
        Noll 2 to `highest_noll`; ``<method>/chi2_nu``.
    """
    scene = scene_of(sample.cube)
    cube = frames_of(scene, expose(scene))
    nolls = range(2, sample.highest_noll + 1)
    numbers = {"introduced_nm": np.array([scene.ncpa_nm.get(noll, 0.0) for noll in nolls])}
    for method, count in sample.frames.items():
        options = CalibrationOptions(method, highest_noll=sample.highest_noll)
        own = replace(cube, images_e=cube.images_e[:count])
        result = calibrate(own, settings_of(scene), options, model_effects_of(scene))
        numbers |= {
            f"{method}/zernike_nm": result.zernike_nm,
            f"{method}/sigma_nm": result.sigma_nm,
            f"{method}/chi2_nu": np.array(result.chi2_nu),
        }
    return numbers


def beyond_nm(nolls: np.ndarray, std_nm: np.ndarray) -> float:
    """RMS standard deviation of the modes that were not introduced [nm]: cross-talk and noise."""
    return float(np.sqrt(np.mean(std_nm[nolls > INTRODUCED] ** 2)))
