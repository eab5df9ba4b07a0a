"""`segment_piston`: segments of the primary mirror out of step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.declaration import Conditions
from irlos_pipe.effects.pupil_steps import PupilSteps, per_part
from irlos_pipe.optics.pupil_division import segment_amplitudes, segment_count, segment_index

KINDS = {"piston_nm": 1}


class SegmentPiston(PupilSteps):
    """Piston of the segments of the pupil.

    Segments of a mirror are phased to some tens of nanometres, and sensors that measure slopes do not see
    what is left. Segments are those that the instrument's profile draws, in the order of their numbers; of a
    pupil that is not drawn with segments, the petals, for which the low-wind effect has tip and tilt too.
    Piston of the whole pupil does nothing: the prior decides.
    """

    name = "segment_piston"
    formula = "Φ → Φ + piston_p on segment p"
    kinds, part_name, sigma_nm = KINDS, "segments", 150.0
    public = per_part(KINDS, "nm, one per segment")
    look_alike = "high_order_ncpa, of which every mode takes a part of the steps; low_wind_effect"
    reference = "Chanan et al. 1998, Appl. Opt. 37, 140; van Kooten et al. 2022, ApJ 932, 109"

    @classmethod
    def variants(cls, conditions: Conditions) -> tuple[Effect, ...]:
        """See `Effect.variants`: petals alone are left to the low-wind effect."""
        if len(conditions.settings.geometry.segments) < 2:
            raise ValueError("the pupil is not drawn with segments")
        return super().variants(conditions)

    @classmethod
    def count_in(cls, geometry: PupilGeometry) -> int:
        """See `DividedPupil.count_in`."""
        return segment_count(geometry)

    @classmethod
    def amplitudes_of(cls, geometry: PupilGeometry, samples: int) -> np.ndarray:
        """See `DividedPupil.amplitudes_of`."""
        return segment_amplitudes(geometry, samples)

    @classmethod
    def index_in(cls, geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """See `DividedPupil.index_in`."""
        return segment_index(geometry, x_m, y_m)

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`."""
        return f"segments that differ by {self.differences(public)[0]:.0f} nm RMS in piston"
