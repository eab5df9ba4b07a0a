"""Images through an array of 2x2 lenslets: a camera behind every quarter of the pupil."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from irlos_pipe.simulate.camera import Camera
from irlos_pipe.simulate.motion_blur import MotionBlur
from irlos_pipe.simulate.pupil import FINE, Pupil
from irlos_pipe.simulate.scene import Scene


class LensletCamera:
    """Images of a scene through lenslets, side by side: lower left and right, upper left and right.

    Parameters
    ----------
    scene, pupil, motion_mas
        As of `Camera`; the pupil is the whole one.
    """

    def __init__(self, scene: Scene, pupil: Pupil, motion_mas: float = 0.0):
        rows, columns = scene.window
        sampling = replace(scene.sampling, pupil_samples=scene.pupil_samples)
        of_one = replace(scene, window=(rows // 2, columns // 2), lenslets=1, sampling=sampling)
        parts = [_quarter(pupil, up, right) for up in (False, True) for right in (False, True)]
        self._cameras = [Camera(of_one, part, motion_mas) for part in parts]
        light = np.array([part.drawn.sum() for part in parts])
        flux = 1 + np.array(scene.lenslet_flux)
        self._flux = flux * light.sum() / (flux @ light)
        self._tilts_nm = pupil.tilts_nm(np.array(scene.lenslet_tilts_mas))

    def images(self, opd_nm: np.ndarray) -> np.ndarray:
        """Return images of wavefronts `opd_nm` (times, n, n), (lenslets, times, rows, columns)."""
        pairs = zip(self._cameras, self._tilts_nm.astype(opd_nm.dtype), strict=True)
        return np.stack([camera.images(opd_nm + tilt_nm) for camera, tilt_nm in pairs])

    def frame(self, images: np.ndarray, positions_mas: np.ndarray | None, blur: MotionBlur) -> np.ndarray:
        """Return the mean of `images` in motion, (rows, columns); see `Camera.frame`."""
        parts = [
            flux * camera.frame(own, positions_mas, blur)
            for camera, own, flux in zip(self._cameras, images, self._flux, strict=True)
        ]
        return np.block([parts[:2], parts[2:]])


def _quarter(pupil: Pupil, up: bool, right: bool) -> Pupil:
    """The part of the pupil above or below the axis, and right or left of it: cells do not cross it."""
    x_m, y_m = pupil.drawing_grid_m()
    drawn = pupil.drawn * ((x_m > 0) == right) * ((y_m > 0) == up)
    cells = len(pupil.u_m)
    return replace(pupil, drawn=drawn, transmission=drawn.reshape(cells, FINE, cells, FINE).mean(axis=(1, 3)))


def camera_of(scene: Scene, pupil: Pupil, motion_mas: float) -> Camera | LensletCamera:
    """Return the camera of a `scene`; `pupil` and `motion_mas` are as of `Camera`."""
    kind = Camera if scene.lenslets == 1 else LensletCamera
    return kind(scene, pupil, motion_mas)
