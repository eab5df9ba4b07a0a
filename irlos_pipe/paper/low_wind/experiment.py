"""How large a low-wind effect a calibration stands, with and without it in the model.

The petals of the pupil are displaced by pistons of a random pattern; the calibration of a cube has piston,
tip and tilt of every petal among its parameters, or knows nothing of petals. All cubes of a sample have the
same NCPAs and the same pattern; they differ in the size of the pattern, in band and in exposure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import REPORTED_NOLLS
from irlos_pipe.effects.pupil_steps import LowWindEffect
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.optics.wavefront import modes_at
from irlos_pipe.paper.common.broad_band import COADDED, FINE, J_AND_H
from irlos_pipe.paper.common.cube import MIRROR_DIVERSITY_NM, CubeSample, ObservedCube
from irlos_pipe.paper.common.observation import conditions_of
from irlos_pipe.paper.common.variants import DEFAULT, VARIANTS
from irlos_pipe.simulate.aperture import petal_count, petal_index
from irlos_pipe.simulate.scene import Scene

PATTERN_STREAM = 4  # child of a sample's seed that the pistons are drawn from
WITHOUT, WITH = "without", "with"
NARROW: Final = "narrow H"
BROAD: Final = "J+H"


@dataclass(frozen=True)
class Recording:
    """How a cube is taken.

    Attributes
    ----------
    band : {"narrow H", "J+H"}
        Through the narrow filter by the mirror, or both broad bands through the lens.
    exposure_s : float
    """

    band: Literal["narrow H", "J+H"]
    exposure_s: float

    @property
    def name(self) -> str:
        """Return what it is called."""
        return f"{self.band}, {self.exposure_s:g} s"


@dataclass(frozen=True)
class LowWindSample:
    """One set of NCPAs and one pattern of petals, in cubes of all sizes of the pattern.

    Attributes
    ----------
    sizes_nm : tuple of float
        Of the pistons [nm RMS over the petals].
    recordings : tuple of Recording
    total_s : float
        Exposure of a whole cube.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    sizes_nm: tuple[float, ...]
    recordings: tuple[Recording, ...]
    total_s: float
    seeing_arcsec: float
    mag_j: float

    @property
    def pattern(self) -> np.ndarray:
        """Return the pistons of the petals, (petals,), of RMS 1 about a mean of 0."""
        rng = np.random.default_rng([*self.seed, PATTERN_STREAM])
        drawn = rng.standard_normal(petal_count(self.facility.pupil))
        drawn -= drawn.mean()
        return drawn / np.sqrt(np.mean(drawn**2))

    def scene(self, recording: Recording, size_nm: float) -> Scene:
        """Return the cube of a recording with petals of a size."""
        frames = max(2, round(self.total_s / recording.exposure_s))
        cube = CubeSample(self.name, self.seed, self.facility, self.seeing_arcsec, frames, self.mag_j)
        scene = replace(
            cube.scene(),
            exposure_s=recording.exposure_s,
            frame_rate_hz=min(10.0, 1 / recording.exposure_s),
            sampling=FINE,
            effects=_effects(size_nm * self.pattern),
            diversity_nm=MIRROR_DIVERSITY_NM,
            diversity_source="mirror",
            detector=COADDED,
        )
        if recording.band == NARROW:
            return scene
        lens = cube.scene().diversity_nm
        return replace(scene, bands=J_AND_H, throughput=1.0, diversity_nm=lens, diversity_source="lens")


def _effects(piston_nm: np.ndarray) -> dict[str, Mapping[str, Any]]:
    return {"low_wind_effect": {"piston_nm": piston_nm.tolist()}} if piston_nm.any() else {}


def estimate(sample: LowWindSample) -> dict[str, float]:
    """Simulate all cubes of a sample and calibrate each without and with the petals in the model.

    Returns
    -------
    dict of str to float
        For every recording, size and model ``<recording>/<size>/<model>/``: ``pupil_nm``, the RMS over the
        pupil of the true minus the estimated wavefront; ``folded_nm``, the same where every petal may be
        whole waves off; ``modes_nm``, in Noll 2–30; ``chi2_nu``. Beside them ``introduced_nm`` of
        ``<recording>/<size>``.
    """
    found: dict[str, float] = {}
    for recording in sample.recordings:
        for size_nm in sample.sizes_nm:
            cube, key = ObservedCube.of(sample.scene(recording, size_nm)), f"{recording.name}/{size_nm:g}"
            found[f"{key}/introduced_nm"] = cube.introduced_wfe_nm()
            for model in (WITHOUT, WITH):
                calibration = calibrated(cube, model)
                left_nm, petal, weight = left_of(cube, calibration)
                folded_nm = folded(left_nm, petal, weight, cube.scene.bands[-1].centre_nm)
                found |= {
                    f"{key}/{model}/pupil_nm": rms(left_nm, weight),
                    f"{key}/{model}/folded_nm": rms(folded_nm, weight),
                    f"{key}/{model}/modes_nm": rms(in_reported_modes(cube, calibration, left_nm), weight),
                    f"{key}/{model}/chi2_nu": calibration.chi2_nu,
                }
    return found


def calibrated(cube: ObservedCube, model: str) -> Calibration:
    """Return the default calibration of a cube, with petals in the `model` or without."""
    petals = [LowWindEffect.under(conditions_of(cube.scene))] if model == WITH else []
    law = cube.scene.facility.ncpa_law
    return VARIANTS[DEFAULT].calibrate(cube.frames, cube.settings, [*cube.effects, *petals], law)


def left_of(cube: ObservedCube, calibration: Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what a calibration leaves of the wavefront of a cube.

    Returns
    -------
    left_nm, petal, weight : ndarray, (points,)
        True minus estimated wavefront at the lit points of the simulator's pupil [nm], the petal there, and
        its transmission.
    """
    exposed = cube.exposed
    lit = exposed.transmission > 0
    u_m = exposed.telescope.u_m
    x_m, y_m = (np.broadcast_to(one, lit.shape)[lit] for one in (u_m[None, :], u_m[:, None]))
    geometry = cube.scene.geometry
    petal = petal_index(geometry, x_m, y_m)
    estimated_nm = calibration.fitted_modes_nm @ modes_at(calibration.nolls, lit)
    steps = calibration.effects.get(LowWindEffect.name)
    if steps:
        piston, tip, tilt = (np.asarray(steps[f"{kind}_nm"]) for kind in ("piston", "tip", "tilt"))
        slope = 2 / (geometry.diameter_m / 2)
        estimated_nm = estimated_nm + piston[petal] + slope * (tip[petal] * x_m + tilt[petal] * y_m)
    return exposed.mean_opd_nm[lit] - estimated_nm, petal, exposed.transmission[lit]


def in_reported_modes(cube: ObservedCube, calibration: Calibration, left_nm: np.ndarray) -> np.ndarray:
    """Return the part of `left_nm`, (points,), in Noll 2–30, fitted beside all other modes of a calibration.

    Petals are no polynomials: fitted alone, these modes would take over what petals have beyond them.
    """
    telescope, lit = cube.exposed.telescope, cube.exposed.transmission > 0
    on_grid_nm = np.zeros(lit.shape)
    on_grid_nm[lit] = left_nm
    found_nm = telescope.fit_zernike_nm(on_grid_nm, max(calibration.nolls))
    return found_nm[: len(REPORTED_NOLLS)] @ modes_at(REPORTED_NOLLS, lit)


def folded(values_nm: np.ndarray, petal: np.ndarray, weight: np.ndarray, wave_nm: float) -> np.ndarray:
    """Return a wavefront less the whole waves by which the mean of a petal is off that of the first.

    Parameters
    ----------
    values_nm, petal, weight : ndarray, (points,)
        See `left_of`.
    wave_nm : float
    """
    means_nm = [
        np.average(values_nm[petal == one], weights=weight[petal == one]) for one in range(petal.max() + 1)
    ]
    waves = np.round((np.array(means_nm) - means_nm[0]) / wave_nm)
    return values_nm - wave_nm * waves[petal]


def rms(values_nm: Sequence[float] | np.ndarray, weight: np.ndarray) -> float:
    """Return the RMS of `values_nm`, (points,), about their mean, weighted by `weight`."""
    mean_nm = np.average(values_nm, weights=weight)
    return float(np.sqrt(np.average((np.asarray(values_nm) - mean_nm) ** 2, weights=weight)))
