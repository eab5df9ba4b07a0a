"""NCPAs that change while a loop runs with the calibration of its beginning.

A part of them lies before the derotator and turns with the field; the others drift. Tip, tilt and focus
stay as they are: what a sensor has of those next to the science camera no loop can see, so only what the
other modes do to its measurements is looked at here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.simulate.scene import Scene, draw_ncpa_nm
from irlos_pipe.simulate.telescope import rotated_nm

AGEING_STREAM = 3  # stream of a night's seed, after those of the telescope


@dataclass(frozen=True)
class Ageing:
    """By how much NCPAs have changed after an hour; both changes are steady."""

    turn_deg: float = 0.0  # angle by which the derotator has turned [deg, anticlockwise]
    turning: float = 0.5  # part of every coefficient that turns with it
    # RMS of what has been added, a wavefront drawn by the instrument's law of NCPAs [nm].
    drift_nm: float = 0.0
    step_s: float = 300.0  # time for which nothing changes: light is simulated once for each

    @property
    def none(self) -> bool:
        """Whether nothing changes."""
        return not (self.turn_deg and self.turning) and not self.drift_nm

    def change_nm(self, scene: Scene, hours: float, seed: int) -> dict[int, float]:
        """Return what has been added to the NCPAs of a `scene` after some `hours`, Noll: nm RMS.

        The `scene` has the NCPAs of the beginning; the `seed` gives the direction of the drift.
        """
        before = {noll: self.turning * value_nm for noll, value_nm in scene.ncpa_nm.items() if noll > DEFOCUS}
        changed = dict.fromkeys(before, 0.0)
        _add(changed, rotated_nm(before, self.turn_deg * hours), 1.0)
        _add(changed, before, -1.0)
        _add(changed, self._drift_per_hour_nm(scene, seed), hours)
        return changed

    def aged(self, scene: Scene, hours: float, seed: int) -> Scene:
        """Return the `scene` with its NCPAs of some `hours` later; see `change_nm`."""
        ncpa_nm = dict(scene.ncpa_nm)
        _add(ncpa_nm, self.change_nm(scene, hours, seed), 1.0)
        return replace(scene, ncpa_nm=ncpa_nm)

    def _drift_per_hour_nm(self, scene: Scene, seed: int) -> dict[int, float]:
        rng = np.random.default_rng([seed, AGEING_STREAM])
        drawn = draw_ncpa_nm(rng, scene.facility.ncpa_law, 1.0)
        shapes = {noll: value for noll, value in drawn.items() if noll > DEFOCUS}
        scale = self.drift_nm / float(np.linalg.norm(list(shapes.values())))
        return {noll: scale * value for noll, value in shapes.items()}


def _add(to_nm: dict[int, float], other_nm: Mapping[int, float], factor: float) -> None:
    for noll, value_nm in other_nm.items():
        to_nm[noll] = to_nm.get(noll, 0.0) + factor * value_nm
