"""What the frames of a run's own ramp show of right exposures: fit, and errors besides those by photons."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.estimate.focus.sensor import Focus
from irlos_pipe.estimate.focus.unexplained import Structure, Unexplained
from irlos_pipe.estimate.lift_errors import FrameErrors, spread_over
from irlos_pipe.stages.lift.results import LiftResults

MISFIT = "misfit"
FEWEST_FRAMES = 6  # frames of a ramp that show how right exposures fit
# Amplitude of structure, and variance of motion, over those of the ramp from which an exposure is another:
# thousands of right ones, simulated in seeing of 0.3 to 1.3", stay below 3.2 and 3.3 times, halo allowed for.
# Motion matters where it imitates more defocus than this many times the most that the ramp shows.
STRUCTURE_TIMES, BLUR_TIMES, SHIFT_TIMES = 4.0, 4.0, 3.0
NOISE_TIMES = 5.0  # errors by noise that are allowed besides
WEIGHTED_AS_FOR = (1.0, 0.1, 0.01)  # part of the noise that weights are for: less gives the core more weight
# Part of the light that the AO residual of a usual night leaves in the halo: speckles grow with it, and it
# cannot be less than none; and what the worst seeing takes from the core.
HALO, MOST_HALO = 0.2, 0.5
USUAL_STRUCTURE, USUAL_BLUR_PX2, USUAL_HALO, USUAL_SHIFT_NM = 0.0024, 0.12, 0.05, 4.0  # where no ramp shows


@dataclass(frozen=True, eq=False)
class Ordinary:
    """What right exposures show beyond the model."""

    frames: int  # of the ramp that has shown it; 0 for values of simulated exposures
    structure: np.ndarray  # (weights,), median of the rest, see `Structure`, for each of `WEIGHTED_AS_FOR`
    largest_structure: np.ndarray  # (weights,), its maximum
    blur_px2: float  # RMS of the variance of image motion
    halo: float  # the largest
    shift_nm: float  # of the defocus, the largest

    @classmethod
    def of(cls, sensor: Focus, images_e: Iterable[np.ndarray]) -> Ordinary:
        """Return what a `sensor` sees in frames of a ramp, `images_e`; the usual if they are too few."""
        seen: list[Unexplained] = []
        structure: list[list[float]] = []
        for image_e in images_e:
            measured, found = sensor.solved(image_e)
            if found is None or not measured.valid:
                continue
            beside = sensor.beside(found)
            seen.append(beside)
            structure.append([one.rest for one in _structures(beside)])
        if len(seen) < FEWEST_FRAMES:
            return cls.usual()
        return cls(
            len(seen),
            np.median(structure, axis=0).clip(0),
            np.max(structure, axis=0).clip(0),
            math.sqrt(np.mean([one.blur_px2**2 for one in seen])),
            max(one.halo for one in seen),
            max(abs(one.shift_nm) for one in seen),
        )

    @classmethod
    def usual(cls) -> Ordinary:
        """Return what simulated exposures in good seeing show."""
        structure = np.full(len(WEIGHTED_AS_FOR), USUAL_STRUCTURE**2)
        return cls(0, structure, 4 * structure, USUAL_BLUR_PX2, USUAL_HALO, USUAL_SHIFT_NM)

    def fits(self, found: Unexplained, largest: float) -> bool:
        """Return whether what is `found` beyond the model is no more than right exposures may have.

        The `largest` part of the light may at most be unexplained, whatever the ramp shows.
        """
        blur_px2 = math.hypot(BLUR_TIMES * self.blur_px2, NOISE_TIMES * found.blur_sigma_px2)
        noise = NOISE_TIMES * found.halo_sigma
        moved = abs(found.blur_px2) > blur_px2 or not -HALO - noise <= found.halo <= MOST_HALO + noise
        if moved and abs(found.shift_nm) > SHIFT_TIMES * self.shift_nm:
            return False
        times = STRUCTURE_TIMES**2 * self._speckled(found)
        for usual, one in zip(self.structure, _structures(found), strict=True):
            sigma, most = NOISE_TIMES * one.sigma, largest**2 * one.star
            if one.rest > math.hypot(min(times * usual, most), sigma) or one.whole > math.hypot(most, sigma):
                return False
        return True

    def growth(self, found: Unexplained) -> tuple[float, float]:
        """Return the growth of errors by structure and halo beyond the ramp's, and one by motion [nm]."""
        structure, largest = found.rest.structure(found.rest.level), self.largest_structure[0]
        factor2 = self._speckled(found)
        if largest > 0:
            factor2 *= max(1.0, (structure.rest - structure.sigma) / largest)
        beyond_nm2 = found.shift_nm**2 - found.shift_sigma_nm**2 - self.shift_nm**2
        return math.sqrt(factor2), math.sqrt(max(beyond_nm2, 0.0))

    def _speckled(self, found: Unexplained) -> float:
        """By how much the light of speckles is more than the ramp's, as far as the halo is surely larger."""
        return 1 + max(found.halo - 2 * found.halo_sigma - self.halo, 0.0) / HALO


def _structures(found: Unexplained) -> list[Structure]:
    return [found.rest.structure(found.rest.level * part) for part in WEIGHTED_AS_FOR]


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """From the error by photons to that of the measurement, as the stage `lift` states it."""

    frames: FrameErrors  # growth by misfit, and error of the instant
    defocus_nm: np.ndarray  # (offsets,), in order
    optics_nm: np.ndarray  # (offsets,), error by the known wavefront there

    @classmethod
    def of(cls, results: LiftResults) -> SharedErrors | None:
        """Return those that a ramp has shown; None where it was measured without the NCPAs, or not at all."""
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
        """Return the standard error of `defocus_nm`, whose error by photons and read-out is `photon_nm` [nm].

        `growth` is by how much that and the error of the instant are larger than those of the ramp's frames,
        `beside_nm` a further error; see `Ordinary.growth`.
        """
        optics_nm = np.interp([defocus_nm], self.defocus_nm, self.optics_nm)
        frames = replace(self.frames, instant_nm=math.hypot(growth * self.frames.instant_nm, beside_nm))
        return float(frames.sigma_nm(np.array([growth * photon_nm]), optics_nm)[0])
