"""Wavefront steps between parts of the pupil: `low_wind_effect` and `segment_piston`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.simulate.effects.base import PupilEffect, RecordingSetup
from irlos_pipe.simulate.petals import petal_count, petal_index, segment_count, segment_index


@dataclass(frozen=True)
class LowWindEffect(PupilEffect):
    """Piston, tip and tilt of the petals, which calm nights bring.

    Attributes
    ----------
    piston_nm, tip_nm, tilt_nm : sequence of float, optional
        One value per petal each, anticlockwise from the one nearest to the +45° diagonal; tip and tilt are
        Noll 2 and 3 of the whole pupil, restricted to the petal.
    """

    name = "low_wind_effect"
    piston_nm: Sequence[float] | None = None
    tip_nm: Sequence[float] | None = None
    tilt_nm: Sequence[float] | None = None

    def misfit(self, setup: RecordingSetup) -> str:
        """See `SimulatedEffect.misfit`: as many values as petals."""
        petals = petal_count(setup.geometry)
        given = {key: getattr(self, key) for key in ("piston_nm", "tip_nm", "tilt_nm")}
        return _misfit(self.name, "petals", petals, {k: v for k, v in given.items() if v is not None})

    def steps_nm(self, geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """See `PupilEffect.steps_nm`."""
        index, radius_m = petal_index(geometry, x_m, y_m), geometry.diameter_m / 2
        none = np.zeros(petal_count(geometry))
        piston, tip, tilt = (
            none if values is None else np.asarray(values, float)
            for values in (self.piston_nm, self.tip_nm, self.tilt_nm)
        )
        return piston[index] + 2 / radius_m * (tip[index] * x_m + tilt[index] * y_m)


@dataclass(frozen=True)
class SegmentPiston(PupilEffect):
    """Piston of the segments of the pupil.

    Attributes
    ----------
    piston_nm : sequence of float
        One value per segment, in the order of their numbers.
    """

    name = "segment_piston"
    piston_nm: Sequence[float]

    def misfit(self, setup: RecordingSetup) -> str:
        """See `SimulatedEffect.misfit`: as many values as segments."""
        return _misfit(self.name, "segments", segment_count(setup.geometry), {"piston_nm": self.piston_nm})

    def steps_nm(self, geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """See `PupilEffect.steps_nm`."""
        return np.asarray(self.piston_nm, float)[segment_index(geometry, x_m, y_m)]


def _misfit(name: str, parts: str, count: int, given: dict[str, Sequence[float]]) -> str:
    """What is wrong with lists that should have one value per part of the pupil."""
    if count < 2:
        return f"effects.{name}: the pupil is not divided into {parts}; leave it out"
    wrong = [key for key, values in given.items() if len(values) != count]
    return f"effects.{name}.{wrong[0]}: the pupil has {count} {parts}; give as many values" if wrong else ""
