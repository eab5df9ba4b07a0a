"""Noise-free frames of a run as a function of the defocus that the loop leaves.

In a closed loop every star, configuration and gain sees another defocus, but the same sky. So every
frame is simulated at a few defoci, and its pixels interpolated between them by a Chebyshev series. An
image depends on defocus through ``exp(2πi a ΔZ₄/λ)``, the differences ΔZ₄ below 3.4 over this pupil: it is
band-limited in a, and the series converges as fast as Bessel functions do beyond their argument.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev

from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.scene import Scene

FOCUS = 4


@dataclass(frozen=True)
class FrameTable:
    """Frames of one scene at any defocus within `reach_nm`.

    Attributes
    ----------
    reach_nm : float
    series_e : ndarray, (orders, frames, rows, columns)
        Chebyshev coefficients of the mean electrons per pixel.
    sky_focus_nm : ndarray, (frames,)
        Defocus of the AO residual itself, the mean over each frame.
    """

    reach_nm: float
    series_e: np.ndarray
    sky_focus_nm: np.ndarray

    def images_e(self, frame: int, defocus_nm: np.ndarray) -> np.ndarray:
        """Return the mean electrons of `frame` at every one of `defocus_nm`, (defoci, rows, columns)."""
        orders, _, *window = self.series_e.shape
        weights = chebyshev.chebvander(np.asarray(defocus_nm) / self.reach_nm, orders - 1)
        flat = self.series_e[:, frame].reshape(orders, -1)
        return (weights @ flat).reshape(-1, *window)


def frame_table(scene: Scene, reach_nm: float, nodes: int) -> FrameTable:
    """Simulate `scene` at the `nodes` Chebyshev nodes of ±`reach_nm`; the sky is the same at all of them."""
    points = chebyshev.chebpts1(nodes)
    exposed = [expose(replace(scene, introduced_nm=float(point * reach_nm))) for point in points]
    to_series = np.linalg.inv(chebyshev.chebvander(points, nodes - 1))
    series = np.tensordot(to_series, np.stack([one.mean_e for one in exposed]), axes=1).astype(np.float32)
    focus = exposed[0].zernike_nm[:, FOCUS - 2] - scene.ncpa_nm.get(FOCUS, 0.0)
    return FrameTable(reach_nm, series, focus)
