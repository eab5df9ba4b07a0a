"""Smooth wavefronts of a scene that do not change during a frame, on any pupil grid."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.simulate.effects.base import FocusStageEffect, LensEffect, WavefrontEffect
from irlos_pipe.simulate.effects.focus_stage import reached_nm
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.telescope import Telescope
from irlos_pipe.simulate.zernikes import rotated_nm


class StaticWavefront:
    """The static, the drifting and the introduced wavefront.

    The wavefront of a frame is *truth + declared*. Declared are the diversity and the introduced defocus
    as the scene states them; everything else is truth, errors of the two included, because that is what
    an estimate finds.

    Parameters
    ----------
    scene : Scene
    telescope : Telescope
        Grid of the wavefronts.
    """

    def __init__(self, scene: Scene, telescope: Telescope):
        self._telescope = telescope
        self._commanded_nm = scene.introduced_per_frame_nm
        reached = reached_nm(self._commanded_nm, scene.acting(FocusStageEffect), scene.rng("focus_stage"))
        self._missed_nm = reached - self._commanded_nm
        shapes = [effect.defocus(telescope) for effect in scene.acting(LensEffect)]
        self._declared_defocus = telescope.mode(DEFOCUS)
        self._defocus = shapes[0] if shapes else self._declared_defocus
        self._diversity_nm = telescope.opd_nm(scene.diversity_nm)
        effects = scene.acting(WavefrontEffect)
        self._static_zernike_nm = static_zernike_nm(scene)
        self._static_nm = telescope.opd_nm(self._static_zernike_nm)
        for effect in effects:
            self._static_nm = self._static_nm + effect.static_opd_nm(telescope)
        if scene.mirror:
            self._static_nm = self._static_nm + scene.mirror.opd_nm(telescope)
        self._drift_zernike_nm = _sum_nm(effect.drift_zernike_nm() for effect in effects)
        self._drift_nm = telescope.opd_nm(self._drift_zernike_nm)
        self._elapsed = np.linspace(0, 1 if self._drift_zernike_nm else 0, scene.frames)

    def truth_nm(self, frame: int) -> np.ndarray:
        """Return the wavefront of a `frame` beyond diversity and introduced defocus as declared [nm]."""
        missed_nm = self._missed_nm[frame] * self._defocus
        shape_nm = self._commanded_nm[frame] * (self._defocus - self._declared_defocus)
        return self._static_nm + self._elapsed[frame] * self._drift_nm + missed_nm + shape_nm

    def truth_zernike_nm(self, frame: int) -> dict[int, float]:
        """Return the modes of `truth_nm` that the scene states as such, Noll: nm RMS; it may have more."""
        elapsed = self._elapsed[frame]
        drift_nm = {noll: elapsed * value_nm for noll, value_nm in self._drift_zernike_nm.items()}
        return _sum_nm([self._static_zernike_nm, drift_nm])

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
    effects = scene.acting(WavefrontEffect)
    return _sum_nm(
        [scene.ncpa_nm, rotated, *(effect.static_zernike_nm(scene.diversity_nm) for effect in effects)]
    )


def _sum_nm(parts: Iterable[Mapping[int, float]]) -> dict[int, float]:
    total: dict[int, float] = {}
    for part in parts:
        for noll, value_nm in part.items():
            total[noll] = total.get(noll, 0.0) + value_nm
    return total
