"""Smooth wavefronts of a scene that do not change during a frame, on any pupil grid."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from irlos_pipe.simulate.checks import SceneError
from irlos_pipe.simulate.focus_stage import reached_nm
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.telescope import Telescope
from irlos_pipe.simulate.zernikes import rotated_nm

DEFOCUS = 4  # Noll


class StaticWavefront:
    """What is static, what drifts, and what the instrument introduces.

    The wavefront of a frame is *truth + told*. Told is the diversity and the introduced defocus as
    the scene states them; everything else is truth, errors of the two included, because that is what
    an estimate finds.

    Parameters
    ----------
    scene : Scene
    telescope : Telescope
        Grid of the wavefronts.
    """

    def __init__(self, scene: Scene, telescope: Telescope):
        self._telescope = telescope
        self._told_nm = scene.introduced_per_frame_nm
        reached = reached_nm(self._told_nm, scene.effects, scene.rng("focus_stage"))
        self._missed_nm = reached - self._told_nm
        self._diversity_nm = telescope.opd_nm(scene.diversity_nm)
        self._static_nm = telescope.opd_nm(static_zernike_nm(scene)) + _bump_nm(scene, telescope)
        drift = scene.effects.get("ncpa_drift", {}).get("zernike_nm", {})
        self._drift_nm = telescope.opd_nm(drift)
        self._elapsed = np.linspace(0, 1 if drift else 0, scene.frames)

    def truth_nm(self, frame: int) -> np.ndarray:
        """Wavefront without the told diversity and introduced defocus, (n, n) [nm]."""
        defocus_nm = self._missed_nm[frame] * self._telescope.mode(DEFOCUS)
        return self._static_nm + self._elapsed[frame] * self._drift_nm + defocus_nm

    def total_nm(self, frame: int) -> np.ndarray:
        """Wavefront with them, (n, n) [nm]."""
        told_nm = self._diversity_nm + self._told_nm[frame] * self._telescope.mode(DEFOCUS)
        return self.truth_nm(frame) + told_nm

    def same(self, frame: int, other: int) -> bool:
        """Whether two frames have the same wavefront."""
        series = (self._told_nm, self._missed_nm, self._elapsed)
        return all(values[frame] == values[other] for values in series)


def static_zernike_nm(scene: Scene) -> dict[int, float]:
    """Static coefficients, Noll: nm RMS.

    NCPAs before and after the derotator, the effect `high_order_ncpa`, and what the diversity differs
    from the told one (`diversity_error`).
    """
    parts = (
        scene.ncpa_nm,
        rotated_nm(scene.rotating_nm, scene.derotator_angle_deg),
        scene.effects.get("high_order_ncpa", {}).get("zernike_nm", {}),
        _diversity_error_nm(scene),
    )
    total: dict[int, float] = {}
    for part in parts:
        for noll, value_nm in part.items():
            total[noll] = total.get(noll, 0.0) + value_nm
    return total


def _diversity_error_nm(scene: Scene) -> dict[int, float]:
    """Diversity of the true amplitude, larger by `nm`, minus the told one."""
    error_nm = scene.effects.get("diversity_error", {}).get("nm", 0.0)
    if error_nm == 0:
        return {}
    amplitude_nm = float(np.linalg.norm(list(scene.diversity_nm.values())))
    if amplitude_nm == 0:
        raise SceneError("effects.diversity_error: the scene has no diversity; give diversity_nm")
    return {noll: value_nm * error_nm / amplitude_nm for noll, value_nm in scene.diversity_nm.items()}


def _bump_nm(scene: Scene, telescope: Telescope) -> np.ndarray:
    """Effect `phase_bump`: a Gaussian of height `nm` and standard deviation `width_m` at (x_m, y_m)."""
    effect: Mapping[str, float] = scene.effects.get("phase_bump", {})
    if not effect:
        return np.zeros_like(telescope.transmission)
    x2 = (telescope.u_m - effect["x_m"]) ** 2
    y2 = (telescope.u_m - effect["y_m"]) ** 2
    return effect["nm"] * np.exp(-(x2[None, :] + y2[:, None]) / (2 * effect["width_m"] ** 2))
