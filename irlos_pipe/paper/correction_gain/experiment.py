"""The star before and after the correction of the calibrated NCPAs (paper, Fig. "improvement").

The cube that is calibrated has the diversity; the star shown has not. The correction is what SPARTA
accepts: Noll 4–30 of the estimate, subtracted from the wavefront. Tip and tilt are the loop's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.paper.common.observation import (
    delta_wfe,
    frames_of,
    model_effects_of,
    settings_of,
    wavefront_nm,
)
from irlos_pipe.paper.common.variants import VARIANTS
from irlos_pipe.paper.methods.experiment import Sample, scene_of
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.scene import Scene

CORRECTED = tuple(range(4, 31))
SEED_OF_STAR = 1  # other residuals than in the cube that was calibrated


@dataclass(frozen=True)
class Star:
    """A cube to calibrate and a star to correct.

    Attributes
    ----------
    frames : int
        Frames of the star's averaged image.
    """

    name: str
    sample: Sample
    frames: int


def correct(star: Star) -> dict[str, np.ndarray]:
    """Calibrate by every variant of the sample and image the star with each correction.

    Returns
    -------
    dict of str to ndarray
        ``<state>/image`` (rows, columns), part of the photons per pixel; ``<state>/strehl``; the states are
        ``before``, ``ideal`` and the variants. ``truth_nm`` and ``<variant>/wavefront_nm`` (n, n).
    """
    scene = scene_of(star.sample)
    exposed = expose(scene)
    arrays = {"truth_nm": np.where(exposed.transmission > 0, exposed.mean_opd_nm, np.nan)}
    arrays |= _image("before", scene, star.frames, {})
    arrays |= _image("ideal", scene, star.frames, dict(scene.ncpa_nm))
    for name in star.sample.variants:
        arrays |= _corrected(name, scene, exposed, star.frames)
    return arrays


def _corrected(name: str, scene: Scene, exposed: Exposed, frames: int) -> dict[str, np.ndarray]:
    result = VARIANTS[name].calibrate(
        frames_of(scene, exposed), settings_of(scene), model_effects_of(scene), scene.facility.ncpa_law
    )
    estimate_nm = dict(zip(result.nolls, result.zernike_nm, strict=True))
    removed_nm = {noll: estimate_nm[noll] for noll in CORRECTED if noll in estimate_nm}
    return {
        f"{name}/wavefront_nm": wavefront_nm(exposed, result.nolls, result.zernike_nm),
        f"{name}/pupil_nm": delta_wfe(exposed, result.nolls, result.zernike_nm).pupil_nm,
        **_image(name, scene, frames, removed_nm),
    }


def _image(state: str, scene: Scene, frames: int, removed_nm: Mapping[int, float]) -> dict[str, np.ndarray]:
    """Averaged image of the star, and its peak over that of a star without any aberration."""
    left_nm = {
        noll: value - removed_nm.get(noll, 0.0) for noll, value in scene.ncpa_nm.items() if noll not in (2, 3)
    }
    star = replace(scene, ncpa_nm=left_nm, diversity_nm={}, frames=frames, seed=(*scene.seed, SEED_OF_STAR))
    image = expose(star).mean_e.mean(axis=0, dtype=float) / star.photons
    perfect = expose(replace(star, ncpa_nm={}, sky=None, motion=None, frames=1)).mean_e[0] / star.photons
    return {f"{state}/image": image, f"{state}/strehl": image.max() / perfect.max()}
