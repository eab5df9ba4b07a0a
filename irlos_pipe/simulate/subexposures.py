"""The sub-exposures of a frame: AO residual and image motion, which change while it is exposed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from irlos_pipe.simulate.motion import SHORTEST_STEP_S, MotionSeries
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.simulate.screens import ResidualScreens
from irlos_pipe.simulate.telescope import Telescope


@dataclass(frozen=True)
class Subexposures:
    """AO residual and image motion during one frame.

    Attributes
    ----------
    screens_nm : ndarray, (times, n, n), float32, or None
        Residual wavefronts at the ends of equal sub-exposures; none without sky.
    positions_mas : ndarray, (times, positions, 2), or None
        Image positions (x, y) within every sub-exposure; none without motion.
    """

    screens_nm: np.ndarray | None
    positions_mas: np.ndarray | None

    @property
    def mean_screen_nm(self) -> np.ndarray | float:
        """Return the mean residual wavefront, (n, n) [nm]."""
        return 0.0 if self.screens_nm is None else self.screens_nm.mean(axis=0, dtype=float)

    @property
    def mean_position_mas(self) -> np.ndarray:
        """Return the mean image position (x, y)."""
        return np.zeros(2) if self.positions_mas is None else self.positions_mas.mean(axis=(0, 1))


class SubexposureSeries:
    """Residual and image motion frame after frame; time runs on between frames.

    Positions follow each other fast enough for the fastest vibration, so lines above the rate of the
    sub-exposures blur them, and are not taken for slow motion.

    Parameters
    ----------
    scene : Scene
    telescope : Telescope
        Grid of the wavefronts.
    """

    def __init__(self, scene: Scene, telescope: Telescope):
        self._times, self._exposure_s = scene.subexposures, scene.exposure_s
        self._idle_s = scene.period_s - scene.exposure_s
        self._screens = (
            ResidualScreens(scene.sky, scene.facility, telescope, scene.rng("sky")) if scene.sky else None
        )
        self._motion = (
            MotionSeries(scene.motion, scene.facility.vibration_lines, scene.rng("motion"))
            if scene.motion
            else None
        )

    def next_frame(self) -> Subexposures:
        """Return residual and motion during the next frame."""
        moving = Subexposures(
            None if self._screens is None else self._next_screens_nm(self._screens),
            None if self._motion is None else self._next_positions_mas(self._motion),
        )
        if self._idle_s > 1e-9:
            for process in (self._screens, self._motion):
                if process is not None:
                    process.skip(self._idle_s)
        return moving

    def _next_screens_nm(self, screens: ResidualScreens) -> np.ndarray:
        step_s = self._exposure_s / self._times
        return np.stack([screens.next_nm(step_s) for _ in range(self._times)])

    def _next_positions_mas(self, motion: MotionSeries) -> np.ndarray:
        step_s = self._exposure_s / self._times
        positions = max(2, int(np.ceil(step_s / SHORTEST_STEP_S - 1e-9)))
        track_mas = motion.next_mas(step_s / positions, self._times * positions)
        return track_mas.reshape(self._times, positions, 2)
