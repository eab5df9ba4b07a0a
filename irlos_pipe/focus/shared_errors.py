"""The error of a loop's measurement with what photons do not tell, as the run's own ramp has shown it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.estimate.lift_errors import FrameErrors, spread_over
from irlos_pipe.stages.lift.results import LiftResults


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """From the error by photons to that of the measurement, as the stage `lift` states it.

    Attributes
    ----------
    frames : FrameErrors
        Growth by misfit, and error of the instant.
    defocus_nm, optics_nm : ndarray, (offsets,)
        Error by the known wavefront at some values of defocus, in order.
    """

    frames: FrameErrors
    defocus_nm: np.ndarray
    optics_nm: np.ndarray

    @classmethod
    def of(cls, results: LiftResults) -> SharedErrors | None:
        """Return those that a ramp has shown; None where it was measured without the NCPAs, or not at all.

        Parameters
        ----------
        results : LiftResults
            Of the ramp.
        """
        defocus_nm = np.array([point.defocus_nm for point in results.points])
        chosen = spread_over(defocus_nm)
        if not results.calibrated or not len(chosen):
            return None
        optics_nm = np.array([point.sigma_optics_nm for point in results.points])[chosen]
        frames = FrameErrors(results.points[0].sigma_instant_nm, results.chi2_nu, results.nominal_chi2_nu)
        return cls(frames, defocus_nm[chosen], optics_nm)

    def sigma_nm(
        self, defocus_nm: float, photon_nm: float, growth: float = 1.0, beside_nm: float = 0.0
    ) -> float:
        """Return the standard error of a measurement [nm].

        Parameters
        ----------
        defocus_nm, photon_nm : float
            The measurement, and its error by photons and read-out.
        growth, beside_nm : float
            By how much the error by photons and of the instant are larger than those of the ramp's frames,
            and a further error; see `Ordinary.growth`.
        """
        optics_nm = np.interp([defocus_nm], self.defocus_nm, self.optics_nm)
        frames = replace(self.frames, instant_nm=math.hypot(growth * self.frames.instant_nm, beside_nm))
        return float(frames.sigma_nm(np.array([growth * photon_nm]), optics_nm)[0])
