"""Exposes the frames of a scene: mean photo-electrons, and the wavefront that made them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.simulate.effects.base import MotionEffect, SkyEffect
from irlos_pipe.simulate.lenslets import camera_of
from irlos_pipe.simulate.motion_blur import STILL, MotionBlur
from irlos_pipe.simulate.pupil import pupil_of, steps_nm
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.subexposures import SubexposureSeries
from irlos_pipe.simulate.telescope import Telescope
from irlos_pipe.simulate.wavefront import StaticWavefront

LAST_NOLL = 31  # of the coefficients kept per frame


@dataclass(frozen=True)
class Exposure:
    """One frame.

    Attributes
    ----------
    mean_e : ndarray, (rows, columns), float64
        Mean photo-electrons.
    opd_nm : ndarray, (n, n)
        Time-mean wavefront, the declared diversity and introduced defocus excluded [nm].
    stated_nm : dict of int to float
        Modes of the wavefront that the scene states as such, Noll: nm RMS.
    """

    mean_e: np.ndarray
    opd_nm: np.ndarray
    stated_nm: dict[int, float]


@dataclass(frozen=True, eq=False)
class Exposed:
    """All frames of a scene.

    Attributes
    ----------
    mean_e : ndarray, (frames, rows, columns), float32
        Mean photo-electrons.
    mean_opd_nm : ndarray, (n, n)
        Wavefront averaged over all frames, the declared diversity and introduced defocus excluded [nm].
    zernike_nm : ndarray, (frames, 30)
        Noll 2..31 of every frame's wavefront: modes that the scene states as such, and a least-squares
        fit of the rest [nm RMS].
    telescope : Telescope
    """

    mean_e: np.ndarray
    mean_opd_nm: np.ndarray
    zernike_nm: np.ndarray
    telescope: Telescope

    @property
    def transmission(self) -> np.ndarray:
        """Return the clear fraction of every cell of the pupil, (n, n)."""
        return self.telescope.transmission

    def mean_zernike_nm(self) -> dict[int, float]:
        """Return Noll 2..31 of the average wavefront: nm RMS."""
        return dict(enumerate(self.zernike_nm.mean(axis=0).tolist(), start=2))


def expose(scene: Scene, report: Callable[[int], None] | None = None) -> Exposed:
    """Expose all frames and keep them.

    Parameters
    ----------
    scene : Scene
    report : callable, optional
        Called with the number of finished frames after every frame.

    Raises
    ------
    SceneError
        For parameters of effects that do not fit the scene.
    """
    telescope = telescope_of(scene)
    mean_e = np.empty((scene.frames, *scene.window), np.float32)
    zernike_nm = np.empty((scene.frames, LAST_NOLL - 1))
    opd_sum_nm = np.zeros(telescope.transmission.shape)
    for index, exposure in enumerate(exposures(scene)):
        mean_e[index] = exposure.mean_e
        zernike_nm[index] = telescope.fit_zernike_nm(exposure.opd_nm, LAST_NOLL, exposure.stated_nm)
        opd_sum_nm += exposure.opd_nm
        if report is not None:
            report(index + 1)
    return Exposed(mean_e, opd_sum_nm / scene.frames, zernike_nm, telescope)


def telescope_of(scene: Scene) -> Telescope:
    """Return the pupil grid of the wavefronts that the exposures of a `scene` have."""
    return pupil_of(with_effective_sky(scene)).telescope


def exposures(scene: Scene) -> Iterator[Exposure]:
    """Yield the frames of a `scene` one by one; memory does not grow with their number."""
    light_path = _LightPath(with_effective_sky(scene))
    for frame in range(scene.frames):
        yield light_path.exposed(frame)


class _LightPath:
    """Turns the wavefronts of a scene into frames, which must be asked for in their order."""

    def __init__(self, scene: Scene):
        self._scene, self._pupil = scene, pupil_of(scene)
        self._wavefront = StaticWavefront(scene, self._pupil)
        self._subexposures = SubexposureSeries(scene, self._pupil)
        self._motion, self._motion_rng = scene.acting(MotionEffect), scene.rng("effects")
        wandering_mas = scene.motion.rms_mas if scene.motion else 0.0
        blurring_mas = float(np.sqrt(sum(effect.sigma_mas**2 for effect in self._motion)))
        self._camera = camera_of(scene, self._pupil, float(np.hypot(wandering_mas, blurring_mas)))
        steps = steps_nm(scene, self._pupil, self._pupil.u_m[None, :], self._pupil.u_m[:, None])
        self._steps_nm: np.ndarray | float = 0.0 if steps is None else steps
        self._resting_images: np.ndarray | None = None

    def exposed(self, frame: int) -> Exposure:
        """Expose the next frame, number `frame`."""
        moving, blur = self._subexposures.next_frame(), self._next_blur()
        images = self._images(frame, moving.screens_nm)
        tilt_nm = self._pupil.tilts_nm((moving.mean_position_mas + blur.mean_mas)[None])[0]
        opd_nm = self._wavefront.truth_nm(frame) + self._steps_nm + moving.mean_screen_nm + tilt_nm
        image = self._camera.frame(images, moving.positions_mas, blur)
        stated_nm = self._wavefront.truth_zernike_nm(frame)
        return Exposure(image * self._scene.photons, self._pupil.inside(opd_nm), stated_nm)

    def _next_blur(self) -> MotionBlur:
        """Motion within the next frame by all effects together."""
        scene, blur = self._scene, STILL
        for effect in self._motion:
            blur = blur + effect.blur(scene.exposure_s, scene.facility.vibration_lines, self._motion_rng)
        return blur

    def _images(self, frame: int, screens_nm: np.ndarray | None) -> np.ndarray:
        """Images of the sub-exposures, or the one of a wavefront at rest, computed where it changes."""
        if screens_nm is not None:
            return self._camera.images(screens_nm + self._wavefront.total_nm(frame).astype(np.float32))
        if self._resting_images is None or not self._wavefront.same(frame, frame - 1):
            self._resting_images = self._camera.images(self._wavefront.total_nm(frame)[None])
        return self._resting_images


def with_effective_sky(scene: Scene) -> Scene:
    """Return the `scene` with the AO residual that its effects leave."""
    sky = scene.sky
    for effect in scene.acting(SkyEffect):
        sky = effect.sky(sky, scene.facility)
    return replace(scene, sky=sky)
