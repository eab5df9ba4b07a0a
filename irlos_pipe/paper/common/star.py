"""The image of a star without diversity, as a correction leaves it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.scene import Scene

SEED_OF_STAR = 1  # other residuals than in the cube that was calibrated


def star_image(cube: Scene, frames: int, ncpa_nm: Mapping[int, float]) -> tuple[np.ndarray, float]:
    """Return the averaged image of the star of a `cube`, and its Strehl ratio.

    Parameters
    ----------
    cube : Scene
        A mirror in it keeps its offsets.
    frames : int
    ncpa_nm : mapping of int to float
        Aberrations in place of those of the cube, Noll: nm RMS.

    Returns
    -------
    ndarray, (rows, columns)
        Part of the photons per pixel.
    float
        Its peak over that of a star without any aberration.
    """
    seed = (*cube.seed, SEED_OF_STAR)
    star = replace(cube, ncpa_nm=dict(ncpa_nm), diversity_nm={}, frames=frames, seed=seed)
    image = expose(star).mean_e.mean(axis=0, dtype=float) / star.photons
    still = replace(star, ncpa_nm={}, mirror=None, sky=None, motion=None, frames=1)
    perfect = expose(still).mean_e[0] / star.photons
    return image, float(image.max() / perfect.max())
