"""Effects on the smooth wavefront: modes, bumps, drifts, colour, focus stage and the lens that it moves."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from irlos_pipe.conventions.keys import key
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.simulate.effects.base import SimulatedEffect
from irlos_pipe.simulate.telescope import Telescope

REST_NM = 0.0  # where the focus stage stands before the first move


@dataclass(frozen=True)
class Modes(SimulatedEffect):
    """Some modes `zernike_nm`, Noll: nm RMS."""

    zernike_nm: Mapping[int, float] = key(ge=-1e4, le=1e4)


class HighOrderNcpa(Modes):
    """Further static modes `zernike_nm`, Noll: nm RMS."""

    name = "high_order_ncpa"

    def static_zernike_nm(self, diversity_nm: Mapping[int, float]) -> Mapping[int, float]:
        return self.zernike_nm


@dataclass(frozen=True)
class DiversityError(SimulatedEffect):
    """The amplitude of the diversity is larger than declared by `nm`."""

    name = "diversity_error"
    nm: float = key(ge=-1e4, le=1e4)

    def misfit(self, scene: Any) -> str:
        if any(scene.diversity_nm.values()):
            return ""
        return "effects.diversity_error needs a diversity; add the section 'diversity'"

    def static_zernike_nm(self, diversity_nm: Mapping[int, float]) -> Mapping[int, float]:
        if self.nm == 0:
            return {}
        amplitude_nm = float(np.linalg.norm(list(diversity_nm.values())))
        return {noll: value_nm * self.nm / amplitude_nm for noll, value_nm in diversity_nm.items()}


@dataclass(frozen=True)
class PhaseBump(SimulatedEffect):
    """A Gaussian of height `nm` and standard deviation `width_m` at (`x_m`, `y_m`)."""

    name = "phase_bump"
    nm: float = key(ge=-1e4, le=1e4)
    x_m: float = key(ge=-10.0, le=10.0)
    y_m: float = key(ge=-10.0, le=10.0)
    width_m: float = key(ge=1e-3, le=10.0)

    def static_opd_nm(self, telescope: Telescope) -> np.ndarray:
        x2, y2 = (telescope.u_m - self.x_m) ** 2, (telescope.u_m - self.y_m) ** 2
        return self.nm * np.exp(-(x2[None, :] + y2[:, None]) / (2 * self.width_m**2))


class NcpaDrift(Modes):
    """Modes that grow linearly from nothing to `zernike_nm`, Noll: nm RMS, over the recording."""

    name = "ncpa_drift"

    def drift_zernike_nm(self) -> Mapping[int, float]:
        return self.zernike_nm


@dataclass(frozen=True)
class ChromaticNcpa(SimulatedEffect):
    """Modes that change in proportion to wavelength, Noll: nm RMS per µm.

    They vanish at `reference_nm`, by default the photon-weighted mean of the bands' centres.
    """

    name = "chromatic_ncpa"
    zernike_nm_per_um: Mapping[int, float] = key(ge=-1e4, le=1e4)
    reference_nm: float | None = key(None, "nm, where they vanish", ge=300.0, le=5000.0)

    def chromatic_zernike_nm(self, wavelength_nm: float, mean_nm: float) -> Mapping[int, float]:
        distance_um = (wavelength_nm - (self.reference_nm or mean_nm)) / 1000
        return {noll: slope * distance_um for noll, slope in self.zernike_nm_per_um.items()}


class FilterNcpa(HighOrderNcpa):
    """The wavefront `zernike_nm` of the filter or lens of this recording, Noll: nm RMS."""

    name = "filter_ncpa"


@dataclass(frozen=True)
class FocusStageScale(SimulatedEffect):
    """The introduced defocus is larger than commanded by a `fraction`."""

    name = "focus_stage_scale"
    fraction: float = key(ge=-1.0, le=10.0)

    def reached_nm(
        self, reached_nm: np.ndarray, commanded_nm: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        return reached_nm * (1 + self.fraction)


@dataclass(frozen=True)
class FocusStageHysteresis(SimulatedEffect):
    """Bias by the direction of travel."""

    name = "focus_stage_hysteresis"
    nm: float = key(ge=-1e4, le=1e4)  # bias after moving towards larger positions, its opposite otherwise
    # RMS of a part that is drawn for every move
    scatter_nm: float = key(0.0, "nm RMS, drawn for every move", ge=0.0, le=5000.0)
    # +1 or -1: direction of the move that led to the first position, if it was not from 0
    direction: float | None = key(None, "+1 or -1, of the move to the first position", ge=-1.0, le=1.0)

    def reached_nm(
        self, reached_nm: np.ndarray, commanded_nm: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        moves = np.cumsum(np.diff(commanded_nm, prepend=commanded_nm[0]) != 0)
        scatter_nm = self.scatter_nm * rng.standard_normal(moves[-1] + 1)[moves]
        return reached_nm + (travel_directions(commanded_nm, self.direction) * self.nm + scatter_nm)


@dataclass(frozen=True)
class FocusStageOffset(SimulatedEffect):
    """Bias `nm` of the commanded positions larger than `above_nm` and smaller than `below_nm`."""

    name = "focus_stage_offset"
    nm: float = key(ge=-1e4, le=1e4)
    above_nm: float | None = None
    below_nm: float | None = None

    def reached_nm(
        self, reached_nm: np.ndarray, commanded_nm: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        above_nm = -np.inf if self.above_nm is None else self.above_nm
        below_nm = np.inf if self.below_nm is None else self.below_nm
        return reached_nm + np.where((commanded_nm > above_nm) & (commanded_nm < below_nm), self.nm, 0.0)


def reached_nm(
    commanded_nm: ArrayLike, effects: Iterable[SimulatedEffect], rng: np.random.Generator
) -> np.ndarray:
    """Return the defocus that the stage introduces, (positions,) [nm RMS].

    ``reached = (1 + fraction) commanded + direction · nm + scatter + bias``, of `commanded_nm` (positions,)
    in the order of time: those of the `effects` that are of the stage act one after the other, drawing from
    `rng`.
    """
    commanded = np.asarray(commanded_nm, float)
    reached = commanded
    for effect in effects:
        if hasattr(effect, "reached_nm"):
            reached = effect.reached_nm(reached, commanded, rng)
    return reached


def travel_directions(commanded_nm: np.ndarray, first: float | None = None) -> np.ndarray:
    """Return the direction of the last move, (positions,): +1 towards larger positions, 0 before any move.

    A stage that stays keeps it. The positions `commanded_nm` are in the order of time; `first` is the
    direction of the move to the first one, by default from `REST_NM`.
    """
    directions, last = [], 0.0
    for index, move in enumerate(np.diff(commanded_nm, prepend=REST_NM)):
        last = first if index == 0 and first is not None else float(np.sign(move)) or last
        directions.append(last)
    return np.array(directions)


@dataclass(frozen=True)
class HighAperture(SimulatedEffect):
    """The focus stage moves the focus where rays of the pupil's rim have the `sine`, NA / n."""

    name = "high_aperture"
    sine: float

    def defocus(self, telescope: Telescope) -> np.ndarray:
        """Return the path ``1 - cos θ`` over its part of Noll 4, (n, n)."""
        s2 = self.sine**2
        if s2 == 0:
            return telescope.mode(DEFOCUS)
        u = telescope.u_m * 2 / telescope.geometry.diameter_m
        cosine = np.sqrt(np.maximum(1 - s2 * (u[None, :] ** 2 + u[:, None] ** 2), 0))
        # ∫ sqrt(1 - s² t) dt and ∫ t sqrt(1 - s² t) dt over t = ρ² from 0 to 1
        q = np.sqrt(1 - s2)
        plain, first = 2 * (1 - q**3) / (3 * s2), (2 * (1 - q**3) / 3 - 2 * (1 - q**5) / 5) / s2**2
        return (plain - cosine) / (np.sqrt(3) * (plain - 2 * first))
