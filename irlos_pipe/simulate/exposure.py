"""Exposes the frames of a scene: mean photo-electrons, and the wavefront that made them.

The wavefront of a frame is *truth + declared*. Declared are the diversity and the introduced defocus as the
scene states them; everything else is truth, errors of the two included, because that is what an estimate
finds.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.simulate.atmosphere import ResidualScreens
from irlos_pipe.simulate.camera import camera_of, pupil_of, steps_nm
from irlos_pipe.simulate.effects.wavefront import reached_nm
from irlos_pipe.simulate.motion import SHORTEST_STEP_S, STILL, MotionSeries
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.telescope import Telescope, rotated_nm, sum_nm

LAST_NOLL = 31  # highest Noll mode of the coefficients kept per frame


@dataclass(frozen=True)
class Exposure:
    mean_e: np.ndarray  # mean photo-electrons, (rows, columns), float64
    opd_nm: np.ndarray  # time-mean wavefront, (n, n), the declared diversity and introduced defocus excluded
    stated_nm: dict[int, float]  # modes of the wavefront that the scene states as such, Noll: nm RMS


@dataclass(frozen=True, eq=False)
class Wavefronts:
    """Wavefronts of all frames of a scene, without the declared diversity and introduced defocus."""

    mean_opd_nm: np.ndarray  # averaged over the frames, (n, n)
    zernike_nm: np.ndarray  # (frames, 30): Noll 2..31 [nm RMS]: stated modes, and a fit of the rest
    telescope: Telescope

    @classmethod
    def of(
        cls, telescope: Telescope, frames: Iterable[tuple[np.ndarray, Mapping[int, float]]], **more: Any
    ) -> Self:
        """Gather wavefronts, (n, n) [nm] each, with the modes that are known of them, Noll: nm RMS."""
        total_nm, zernike_nm = np.zeros_like(telescope.transmission), []
        for opd_nm, stated_nm in frames:
            total_nm += opd_nm
            zernike_nm.append(telescope.fit_zernike_nm(opd_nm, LAST_NOLL, stated_nm))
        return cls(total_nm / len(zernike_nm), np.array(zernike_nm), telescope, **more)

    @property
    def transmission(self) -> np.ndarray:
        """Return the clear fraction of every cell of the pupil, (n, n)."""
        return self.telescope.transmission

    def mean_zernike_nm(self) -> dict[int, float]:
        """Return Noll 2..31 of the average: nm RMS."""
        return dict(enumerate(self.zernike_nm.mean(axis=0).tolist(), start=2))


@dataclass(frozen=True, eq=False)
class Exposed(Wavefronts):
    mean_e: np.ndarray  # mean photo-electrons, (frames, rows, columns), float32


def expose(scene: Scene) -> Exposed:
    """Expose all frames of a `scene` and keep them.

    Raises `SceneError` for parameters of effects that do not fit the scene.
    """
    mean_e = np.empty((scene.frames, *scene.window), np.float32)

    def wavefronts() -> Iterator[tuple[np.ndarray, dict[int, float]]]:
        for index, exposure in enumerate(exposures(scene)):
            mean_e[index] = exposure.mean_e
            yield exposure.opd_nm, exposure.stated_nm

    return Exposed.of(telescope_of(scene), wavefronts(), mean_e=mean_e)


def telescope_of(scene: Scene) -> Telescope:
    """Return the pupil grid of the wavefronts that the exposures of a `scene` have."""
    return pupil_of(with_effective_sky(scene)).telescope


def exposures(scene: Scene) -> Iterator[Exposure]:
    """Yield the frames of a `scene` one by one; memory does not grow with their number."""
    light_path = _LightPath(with_effective_sky(scene))
    for frame in range(scene.frames):
        yield light_path.exposed(frame)


def with_effective_sky(scene: Scene) -> Scene:
    """Return the `scene` with the AO residual that its effects leave."""
    sky = scene.sky
    for effect in scene.acting("sky"):
        sky = effect.sky(sky, scene.facility)
    return replace(scene, sky=sky)


class _LightPath:
    """Turns the wavefronts of a scene into frames, which must be asked for in their order."""

    def __init__(self, scene: Scene):
        self._scene, self._pupil = scene, pupil_of(scene)
        self._wavefront = StaticWavefront(scene, self._pupil)
        self._subexposures = SubexposureSeries(scene, self._pupil)
        self._motion, self._motion_rng = scene.acting("blur"), scene.rng("effects")
        wandering_mas = scene.motion.rms_mas if scene.motion else 0.0
        blurring_mas = float(np.sqrt(sum(effect.sigma_mas**2 for effect in self._motion)))
        self._camera = camera_of(scene, self._pupil, float(np.hypot(wandering_mas, blurring_mas)))
        steps = steps_nm(scene, self._pupil, self._pupil.u_m[None, :], self._pupil.u_m[:, None])
        self._steps_nm: np.ndarray | float = 0.0 if steps is None else steps
        self._resting_images: np.ndarray | None = None

    def exposed(self, frame: int) -> Exposure:
        scene, blur = self._scene, STILL
        screens_nm, positions_mas = self._subexposures.next_frame()
        for effect in self._motion:
            blur = blur + effect.blur(scene.exposure_s, scene.facility.vibration_lines, self._motion_rng)
        images = self._images(frame, screens_nm)
        mean_screen_nm = 0.0 if screens_nm is None else screens_nm.mean(axis=0, dtype=float)
        mean_mas = np.zeros(2) if positions_mas is None else positions_mas.mean(axis=(0, 1))
        tilt_nm = self._pupil.tilts_nm((mean_mas + blur.mean_mas)[None])[0]
        opd_nm = self._wavefront.truth_nm(frame) + self._steps_nm + mean_screen_nm + tilt_nm
        image = self._camera.frame(images, positions_mas, blur)
        return Exposure(image * scene.photons, self._pupil.inside(opd_nm), self._wavefront.stated_nm(frame))

    def _images(self, frame: int, screens_nm: np.ndarray | None) -> np.ndarray:
        """Images of the sub-exposures, or the one of a wavefront at rest, computed where it changes."""
        if screens_nm is not None:
            return self._camera.images(screens_nm + self._wavefront.total_nm(frame).astype(np.float32))
        if self._resting_images is None or not self._wavefront.same(frame, frame - 1):
            self._resting_images = self._camera.images(self._wavefront.total_nm(frame)[None])
        return self._resting_images


class SubexposureSeries:
    """AO residual and image motion of a `scene` frame after frame, on a `telescope`.

    They change while a frame is exposed, and time runs on between frames. Positions follow each other fast
    enough for the fastest vibration, so lines above the rate of the sub-exposures blur them, and are not
    taken for slow motion.
    """

    def __init__(self, scene: Scene, telescope: Telescope):
        self._times, self._step_s = scene.subexposures, scene.exposure_s / scene.subexposures
        self._idle_s = scene.period_s - scene.exposure_s
        self._screens = (
            ResidualScreens(scene.sky, scene.facility, telescope, scene.rng("sky")) if scene.sky else None
        )
        self._motion = (
            MotionSeries(scene.motion, scene.facility.vibration_lines, scene.rng("motion"))
            if scene.motion
            else None
        )

    def next_frame(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return residual and motion during the next frame; None without sky, and without motion.

        The residual wavefronts, (times, n, n) in float32 [nm], are those at the ends of equal sub-exposures;
        the image positions (x, y) are within every sub-exposure, (times, positions, 2) [mas].
        """
        screens_nm = positions_mas = None
        if self._screens is not None:
            screens_nm = np.stack([self._screens.next_nm(self._step_s) for _ in range(self._times)])
        if self._motion is not None:
            positions = max(2, int(np.ceil(self._step_s / SHORTEST_STEP_S - 1e-9)))
            track_mas = self._motion.next_mas(self._step_s / positions, self._times * positions)
            positions_mas = track_mas.reshape(self._times, positions, 2)
        if self._idle_s > 1e-9:
            for process in (self._screens, self._motion):
                if process is not None:
                    process.skip(self._idle_s)
        return screens_nm, positions_mas


class StaticWavefront:
    """The static, the drifting and the introduced wavefront of a `scene` on the grid of a `telescope`."""

    def __init__(self, scene: Scene, telescope: Telescope):
        self._commanded_nm = scene.introduced_per_frame_nm
        reached = reached_nm(self._commanded_nm, scene.acting("reached_nm"), scene.rng("focus_stage"))
        self._missed_nm = reached - self._commanded_nm
        shapes = [effect.defocus(telescope) for effect in scene.acting("defocus")]
        self._declared_defocus = telescope.mode(DEFOCUS)
        self._defocus = shapes[0] if shapes else self._declared_defocus
        self._diversity_nm = telescope.opd_nm(scene.diversity_nm)
        self._static_zernike_nm = static_zernike_nm(scene)
        self._static_nm = telescope.opd_nm(self._static_zernike_nm)
        for effect in scene.acting("static_opd_nm"):
            self._static_nm = self._static_nm + effect.static_opd_nm(telescope)
        if scene.mirror:
            self._static_nm = self._static_nm + scene.mirror.opd_nm(telescope)
        self._drift_zernike_nm = sum_nm(one.drift_zernike_nm() for one in scene.acting("drift_zernike_nm"))
        self._drift_nm = telescope.opd_nm(self._drift_zernike_nm)
        self._elapsed = np.linspace(0, 1 if self._drift_zernike_nm else 0, scene.frames)

    def truth_nm(self, frame: int) -> np.ndarray:
        """Return the wavefront of a `frame` beyond diversity and introduced defocus as declared [nm]."""
        missed_nm = self._missed_nm[frame] * self._defocus
        shape_nm = self._commanded_nm[frame] * (self._defocus - self._declared_defocus)
        return self._static_nm + self._elapsed[frame] * self._drift_nm + missed_nm + shape_nm

    def stated_nm(self, frame: int) -> dict[int, float]:
        """Return the modes of `truth_nm` that the scene states as such, Noll: nm RMS; it may have more."""
        elapsed = self._elapsed[frame]
        drift_nm = {noll: elapsed * value_nm for noll, value_nm in self._drift_zernike_nm.items()}
        return sum_nm([self._static_zernike_nm, drift_nm])

    def total_nm(self, frame: int) -> np.ndarray:
        """Return the whole wavefront of a `frame`, (n, n) [nm]."""
        declared_nm = self._diversity_nm + self._commanded_nm[frame] * self._declared_defocus
        return self.truth_nm(frame) + declared_nm

    def same(self, frame: int, other: int) -> bool:
        """Return whether the frames number `frame` and `other` have the same wavefront."""
        series = (self._commanded_nm, self._missed_nm, self._elapsed)
        return all(values[frame] == values[other] for values in series)


def static_zernike_nm(scene: Scene) -> dict[int, float]:
    """Return NCPAs before and after the derotator, and static modes of the effects, Noll: nm RMS."""
    rotated = rotated_nm(scene.rotating_nm, scene.derotator_angle_deg)
    of_effects = (
        effect.static_zernike_nm(scene.diversity_nm) for effect in scene.acting("static_zernike_nm")
    )
    return sum_nm([scene.ncpa_nm, rotated, *of_effects])
