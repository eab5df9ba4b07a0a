"""`low_wind_effect`: petals of the pupil out of step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects.pupil_steps import PupilSteps, per_part
from irlos_pipe.optics.pupil_division import petal_amplitudes, petals_of

KINDS = {"piston_nm": 1, "tip_nm": 2, "tilt_nm": 3}


class LowWindEffect(PupilSteps):
    """Differential piston, tip and tilt of the petals between the vanes.

    In calm nights the vanes cool the air beside them, and the wavefront steps from petal to petal by up to
    a micrometre; Shack–Hartmann sensors do not see the steps. Each petal has its piston and, as tip and
    tilt, Noll 2 and 3 of the whole pupil restricted to it. Petals are the connected parts of the clear
    pupil, however many there are, counted anticlockwise from the one nearest to the +45° diagonal; gaps
    between segments do not part them, and they turn with vanes that `pupil_misregistration` turns. Piston of
    the whole pupil does nothing, and common tip and tilt are Noll 2 and 3: the prior decides.
    """

    name = "low_wind_effect"
    formula = "Φ → Φ + Σ_p [piston_p + tip_p Z₂ + tilt_p Z₃] on petal p"
    belongs_to = "moment"
    kinds, part_name, sigma_nm = KINDS, "petals", 300.0
    public = per_part(KINDS, "nm, petals anticlockwise from +45°")
    look_alike = "high_order_ncpa, of which every mode takes a part of the steps"
    reference = "Milli et al. 2018, SPIE 10703, 107032A; Sauvage et al. 2016, SPIE 9909, 990916"

    @classmethod
    def count_in(cls, geometry: PupilGeometry) -> int:
        """See `DividedPupil.count_in`."""
        return petals_of(geometry).count

    @classmethod
    def amplitudes_of(cls, geometry: PupilGeometry, samples: int) -> np.ndarray:
        """See `DividedPupil.amplitudes_of`."""
        return petal_amplitudes(geometry, samples)

    @classmethod
    def index_in(cls, geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """See `DividedPupil.index_in`."""
        return petals_of(geometry).index(x_m, y_m)

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: how much petals differ; what they have in common is no low-wind effect."""
        piston_nm, slopes_nm = self.differences(public)
        return (
            f"petals that differ by {piston_nm:.0f} nm RMS in piston and {slopes_nm:.0f} nm in tip and tilt"
        )
