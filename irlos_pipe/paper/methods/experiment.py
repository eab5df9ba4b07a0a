"""Methods compared on simulated cubes (paper, Fig. "methods"), and what each part of the default contributes.

One sample is one cube with its own NCPAs and its own AO residual. Beside the seeing, the residual's
power spectrum can have another shape than the model of the default assumes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.paper.common.cube import CubeSample, ObservedCube
from irlos_pipe.paper.common.variants import DEFAULT, VARIANTS


@dataclass(frozen=True)
class Sample:
    """One cube, and the ways it is calibrated.

    Attributes
    ----------
    variants : tuple of str
        Keys of `VARIANTS`.
    fractions : tuple of float
        Parts of the cube to which the default is applied as well.
    """

    cube: CubeSample
    variants: tuple[str, ...]
    fractions: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Return the name of the cube."""
        return self.cube.name


def compare(sample: Sample) -> dict[str, float]:
    """Simulate a cube and calibrate it in every way.

    Returns
    -------
    dict of str to float
        ``<variant>/modes_nm`` and ``<variant>/pupil_nm`` (Δ-WFE in Noll 2–30 and over the full pupil),
        ``<variant>/chi2_nu``, ``fraction_<part>/modes_nm``, and ``introduced_nm``.
    """
    cube = ObservedCube.of(sample.cube.scene())
    numbers = {"introduced_nm": cube.introduced_wfe_nm()}
    for name in sample.variants:
        calibration = cube.calibrated(VARIANTS[name])
        numbers |= {
            f"{name}/modes_nm": cube.modes_delta_nm(calibration),
            f"{name}/pupil_nm": cube.pupil_delta_nm(calibration),
            f"{name}/chi2_nu": calibration.chi2_nu,
        }
    for part in sample.fractions:
        fewer = cube.first(max(2, round(part * len(cube.frames.images_e))))
        calibration = fewer.calibrated(VARIANTS[DEFAULT])
        numbers[f"fraction_{part:g}/modes_nm"] = fewer.modes_delta_nm(calibration)
    return numbers


def speckle_floor_nm(errors_nm: Mapping[float, Sequence[float]]) -> tuple[float, float]:
    """Split the default's error into a part that falls with the number of frames and the rest.

    ``error² = floor² / part + rest²``, least squares over the mean squares at every part of the cube.

    Parameters
    ----------
    errors_nm : mapping
        Errors over samples by the part of the cube that was used, 1 for the whole cube.

    Returns
    -------
    floor_nm, rest_nm : float
        Error from the finite number of speckles in the whole cube; error of an endless cube.
    """
    parts = np.array(sorted(errors_nm))
    squares = np.array([np.mean(np.square(errors_nm[part])) for part in parts])
    # The mean squares have similar relative errors, so every equation is divided by its own square.
    design = np.stack([1 / parts, np.ones(len(parts))], axis=1) / squares[:, None]
    noise, rest = np.maximum(np.linalg.lstsq(design, np.ones(len(parts)), rcond=None)[0], 0)
    return float(np.sqrt(noise)), float(np.sqrt(rest))
