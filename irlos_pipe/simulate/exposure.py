"""Exposes the frames of a scene: mean photo-electrons, and the wavefront that made them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.camera import Camera
from irlos_pipe.simulate.disturbance import Disturbances
from irlos_pipe.simulate.pupil import petals_nm, pupil_of
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.shaking import Shaking
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
        Time-mean wavefront, the told diversity and introduced defocus excluded [nm].
    """

    mean_e: np.ndarray
    opd_nm: np.ndarray


@dataclass(frozen=True, eq=False)
class Exposed:
    """All frames of a scene.

    Attributes
    ----------
    mean_e : ndarray, (frames, rows, columns), float32
        Mean photo-electrons.
    mean_opd_nm : ndarray, (n, n)
        Wavefront averaged over all frames, the told diversity and introduced defocus excluded [nm].
    zernike_nm : ndarray, (frames, 30)
        Least-squares coefficients of Noll 2..31 of every frame's wavefront [nm RMS].
    telescope : Telescope
    """

    mean_e: np.ndarray
    mean_opd_nm: np.ndarray
    zernike_nm: np.ndarray
    telescope: Telescope

    @property
    def transmission(self) -> np.ndarray:
        """Clear fraction of every cell of the pupil, (n, n)."""
        return self.telescope.transmission

    def mean_zernike_nm(self, last_noll: int = LAST_NOLL) -> dict[int, float]:
        """Least-squares coefficients of the average wavefront, Noll 2..last_noll: nm RMS."""
        values = self.telescope.fit_zernike_nm(self.mean_opd_nm, last_noll)
        return dict(enumerate(values.tolist(), start=2))


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
        zernike_nm[index] = telescope.fit_zernike_nm(exposure.opd_nm, LAST_NOLL)
        opd_sum_nm += exposure.opd_nm
        if report is not None:
            report(index + 1)
    return Exposed(mean_e, opd_sum_nm / scene.frames, zernike_nm, telescope)


def telescope_of(scene: Scene) -> Telescope:
    """Pupil grid of the wavefronts that the exposures of a scene return."""
    return pupil_of(with_halo(scene)).telescope


def exposures(scene: Scene) -> Iterator[Exposure]:
    """Yield the frames of a scene one by one; memory does not grow with their number."""
    light_path = _LightPath(with_halo(scene))
    for frame in range(scene.frames):
        yield light_path.exposed(frame)


class _LightPath:
    """Turns the wavefronts of a scene into frames, which must be asked for in their order."""

    def __init__(self, scene: Scene):
        self._photons, self._pupil = scene.photons, pupil_of(scene)
        self._wavefront, self._shaking = StaticWavefront(scene, self._pupil), Shaking(scene)
        self._disturbances = Disturbances(scene, self._pupil)
        wandering_mas = scene.motion.rms_mas if scene.motion else 0.0
        self._camera = Camera(scene, self._pupil, float(np.hypot(wandering_mas, self._shaking.rms_mas)))
        self._petals_nm = petals_nm(scene, self._pupil, self._pupil.u_m[None, :], self._pupil.u_m[:, None])
        self._resting_images: np.ndarray | None = None

    def exposed(self, frame: int) -> Exposure:
        """The next frame."""
        moving, shake = self._disturbances.next_frame(), self._shaking.next_frame()
        images = self._images(frame, moving.screens_nm)
        tilt_nm = self._pupil.tilts_nm((moving.mean_position_mas + shake.mean_mas)[None])[0]
        opd_nm = self._wavefront.truth_nm(frame) + self._petals_nm + moving.mean_screen_nm + tilt_nm
        image = self._camera.frame(images, moving.positions_mas, shake)
        return Exposure(image * self._photons, self._pupil.inside(opd_nm))

    def _images(self, frame: int, screens_nm: np.ndarray | None) -> np.ndarray:
        """Images of the sub-exposures, or the one of a wavefront at rest, computed where it changes."""
        if screens_nm is not None:
            return self._camera.images(screens_nm + self._wavefront.total_nm(frame).astype(np.float32))
        if self._resting_images is None or not self._wavefront.same(frame, frame - 1):
            self._resting_images = self._camera.images(self._wavefront.total_nm(frame)[None])
        return self._resting_images


def with_halo(scene: Scene) -> Scene:
    """The scene with the AO residual that the effect `seeing_halo` makes.

    The residual is larger by the factor `scale`, or `wfe_nm` in total, its spectrum of the same shape.
    On the bench it is added to nothing: the factor then is one on the residual at
    the facility's typical seeing.
    """
    effect = scene.effects.get("seeing_halo")
    if effect is None:
        return scene
    facility = scene.facility
    sky, law = scene.sky or Sky(facility.typical_seeing_arcsec), facility.residual_law
    factor = effect["wfe_nm"] / sky.total_nm(law) if "wfe_nm" in effect else effect.get("scale", 1.0)
    return replace(scene, sky=sky.scaled(factor, law) if factor > 0 else None)
