"""The star before and after the correction of the calibrated NCPAs (paper, Fig. "improvement").

The cube that is calibrated has the diversity; the star shown has not. The correction is what SPARTA
accepts: Noll 4–30 of the estimate, subtracted from the wavefront. Tip and tilt are the loop's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.modes import CORRECTED_NOLLS, TIP_TILT
from irlos_pipe.paper.common.cube import CubeSample, ObservedCube
from irlos_pipe.paper.common.star import star_image
from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE, VARIANTS
from irlos_pipe.simulate.scene import Scene

COMPARED = (DEFAULT, PAPER_CHOICE)
STATES = ("before", *COMPARED, "ideal")


@dataclass(frozen=True)
class Star:
    """A cube to calibrate and a star to correct.

    Attributes
    ----------
    frames : int
        Frames of the star's averaged image.
    """

    cube: CubeSample
    frames: int

    @property
    def name(self) -> str:
        """Return the name of the cube."""
        return self.cube.name


def correct(star: Star) -> dict[str, np.ndarray]:
    """Calibrate by every method of `COMPARED` and image the star with each correction.

    Returns
    -------
    dict of str to ndarray
        ``<state>/image`` (rows, columns), part of the photons per pixel, and ``<state>/strehl`` for
        `STATES`; ``truth_nm`` and ``<method>/wavefront_nm`` (n, n); ``<method>/pupil_nm``, Δ-WFE;
        ``pixel_scale_mas``.
    """
    cube = ObservedCube.of(star.cube.scene())
    scene, exposed = cube.scene, cube.exposed
    arrays = {
        "truth_nm": np.where(exposed.transmission > 0, exposed.mean_opd_nm, np.nan),
        "pixel_scale_mas": np.array(scene.pixel_scale_mas),
    }
    arrays |= _image("before", scene, star.frames, {})
    arrays |= _image("ideal", scene, star.frames, dict(scene.ncpa_nm))
    for name in COMPARED:
        arrays |= _corrected(name, cube, star.frames)
    return arrays


def _corrected(name: str, cube: ObservedCube, frames: int) -> dict[str, np.ndarray]:
    calibration = cube.calibrated(VARIANTS[name])
    estimate_nm = dict(zip(calibration.nolls, calibration.zernike_nm, strict=True))
    removed_nm = {noll: estimate_nm[noll] for noll in CORRECTED_NOLLS if noll in estimate_nm}
    return {
        f"{name}/wavefront_nm": cube.wavefront_nm(calibration),
        f"{name}/pupil_nm": np.array(cube.pupil_delta_nm(calibration)),
        **_image(name, cube.scene, frames, removed_nm),
    }


def _image(state: str, scene: Scene, frames: int, removed_nm: Mapping[int, float]) -> dict[str, np.ndarray]:
    """Averaged image of the star, and its peak over that of a star without any aberration."""
    left_nm = {
        noll: value - removed_nm.get(noll, 0.0)
        for noll, value in scene.ncpa_nm.items()
        if noll not in TIP_TILT
    }
    image, strehl = star_image(scene, frames, left_nm)
    return {f"{state}/image": image, f"{state}/strehl": np.array(strehl)}
