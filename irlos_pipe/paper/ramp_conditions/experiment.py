"""Calibrated ramps whose light has what the calibration in a narrow band could not show.

The pair is the real one: a cube through the narrow filter with the astigmatism of the mirror, and ramps in
J and H through the lens. All ramps of a sample have the same NCPAs, AO residual and stream of noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions import bands
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import DEFOCUS, TIP_TILT
from irlos_pipe.effects import Effect
from irlos_pipe.effects.chromatic import ChromaticNcpa, FilterNcpa
from irlos_pipe.effects.colour import AtmosphericDispersion
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampFit, fit_ramp, ramp_effects, start_from_defocus
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper.common.broad_band import FINE
from irlos_pipe.paper.common.cube import MIRROR_DIVERSITY_NM, CubeSample
from irlos_pipe.paper.common.observation import conditions_of, model_effects_of, settings_of
from irlos_pipe.paper.common.ramps import (
    DEFAULT,
    RAMP_STREAM,
    Knowledge,
    ObservedRamp,
    calibrated,
    observe,
    ramp_scene,
    true_modes_nm,
)
from irlos_pipe.paper.ramp_conditions.conditions import CONDITIONS, WAYS, Condition, Way
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.stages.model.colour import star_colour

CHROMATIC_STREAM, FILTER_STREAM = 2, 3  # children of a sample's seed, beside that of the ramp
WAVEFRONT_MODES = 50  # as many as the NCPAs have
NARROW_EXPOSURE_S, NARROW_MAG_J = 0.1, 7.1  # of the paper's second ramp on sky
HELD_NM = 1e-3  # width of a prior that holds what it is put on


@dataclass(frozen=True)
class ConditionsSample:
    """One set of NCPAs: a cube to calibrate them, and one ramp under every condition.

    Attributes
    ----------
    offsets_nm : tuple of float
        Introduced defocus.
    conditions : tuple of str
        Keys of `CONDITIONS`.
    """

    name: str
    seed: tuple[int, ...]
    facility: Facility
    offsets_nm: tuple[float, ...]
    frames_per_offset: int
    cube_frames: int
    conditions: tuple[str, ...]
    seeing_arcsec: float
    cube_mag_j: float
    ramp_mag_j: float

    def cube(self) -> Scene:
        """Return the calibration cube, through the narrow filter by the mirror."""
        cube = CubeSample(
            self.name, self.seed, self.facility, self.seeing_arcsec, self.cube_frames, self.cube_mag_j
        )
        return replace(
            cube.scene(), diversity_nm=MIRROR_DIVERSITY_NM, diversity_source="mirror", sampling=FINE
        )

    def ramp(self, condition: Condition) -> Scene:
        """Return the ramp under a condition."""
        cube = self.cube()
        introduced_nm = tuple(np.repeat(self.offsets_nm, self.frames_per_offset).tolist())
        if condition.bands == "narrow H":
            return replace(
                cube,
                role="defocus_ramp",
                seed=(*self.seed, RAMP_STREAM),
                frames=len(introduced_nm),
                exposure_s=NARROW_EXPOSURE_S,
                mag_j=NARROW_MAG_J,
                introduced_nm=introduced_nm,
            )
        ramp = ramp_scene(cube, self.ramp_mag_j, introduced_nm)
        return replace(ramp, effects=self._effects(condition))

    def _effects(self, condition: Condition) -> dict[str, Mapping[str, Any]]:
        """The simulator's effects of a condition, by name."""
        effects: dict[str, Mapping[str, Any]] = {}
        if condition.chromatic_nm:
            per_um = condition.chromatic_nm / (bands.H.centre_nm - bands.J.centre_nm) * 1e3
            effects["chromatic_ncpa"] = {
                "zernike_nm_per_um": self._drawn_nm(CHROMATIC_STREAM, DEFOCUS, per_um),
                "reference_nm": bands.NARROW_H.centre_nm,
            }
        if condition.filter_nm:
            drawn_nm = self._drawn_nm(FILTER_STREAM, DEFOCUS + 1, condition.filter_nm)
            effects["filter_ncpa"] = {"zernike_nm": drawn_nm}
        if condition.dispersion_mas_per_um:
            effects["atmospheric_dispersion"] = {
                "mas_per_um": condition.dispersion_mas_per_um,
                "angle_deg": condition.angle_deg,
            }
        if condition.colour_per_um:
            effects["spectrum"] = {"slope": condition.colour_per_um}
        return effects

    def _drawn_nm(self, stream: int, first: int, total_nm: float) -> dict[int, float]:
        """A wavefront by the law of the NCPAs from Noll `first` on, of `total_nm` RMS.

        Tip and tilt of the colours are dispersion, and the focus of a lens is that of the star.
        """
        rng = np.random.default_rng([*self.seed, stream])
        drawn = draw_ncpa_nm(rng, self.facility.ncpa_law, 1.0, WAVEFRONT_MODES)
        kept = {noll: value for noll, value in drawn.items() if noll >= first}
        norm = float(np.linalg.norm(list(kept.values())))
        return {noll: value * total_nm / norm for noll, value in kept.items()}


def estimate(sample: ConditionsSample) -> dict[str, np.ndarray]:
    """Simulate the cube and all ramps of a sample, and estimate every ramp in every way of its condition.

    Returns
    -------
    dict of str to ndarray
        ``introduced_nm`` (frames,). For every condition ``<condition>/true_nm`` (frames, 10), Noll 2–11 of
        the frame's own mean wavefront at the wavelength of the calibration, introduced defocus included
        and diversity not. For every way ``<condition>/<way>/modes_nm`` and ``sigma_nm`` (frames, modes), the
        same modes as estimated, NCPAs given to it included, and their errors by photon noise;
        ``given_defocus_nm``, the part of the defocus that was given; and ``converged``.
    """
    knowledge = calibrated(sample.cube(), [DEFAULT])
    found: dict[str, np.ndarray] = {}
    for key in sample.conditions:
        condition = CONDITIONS[key]
        ramp = sample.ramp(condition)
        exposed = expose(ramp)
        observed = observe(ramp, exposed, knowledge)
        found["introduced_nm"] = ramp.introduced_per_frame_nm
        found[f"{key}/true_nm"] = true_modes_nm(ramp, exposed)
        for name in condition.ways:
            way = WAYS[name]
            fit = fit_way(observed, way)
            given = given_to(observed, way).ncpa_nm
            found |= {
                f"{key}/{name}/modes_nm": fit.result.zernike_nm.numpy()
                + [given.get(noll, 0.0) for noll in way.modes],
                f"{key}/{name}/sigma_nm": fit.result.sigma_nm.numpy(),
                f"{key}/{name}/given_defocus_nm": np.array(given.get(DEFOCUS, 0.0)),
                f"{key}/{name}/converged": fit.result.solution.converged.numpy(),
            }
    return found


def given_to(ramp: ObservedRamp, way: Way) -> Knowledge:
    """Return what a way knows of the calibration."""
    return ramp.knowledge[DEFAULT if way.calibrated else ""]


def fit_way(ramp: ObservedRamp, way: Way) -> RampFit:
    """Estimate all frames of a ramp in one way, with the model and the sampling of the stage `lift`."""
    known = given_to(ramp, way)
    settings = settings_of(ramp.scene, known.ncpa_nm).for_single_frames()
    model = PsfModel(settings, way.modes)
    start_nm = start_from_defocus(model, ramp.data, ramp.prior_nm - known.ncpa_nm.get(DEFOCUS, 0.0))
    effects = ramp_effects(model_effects_of(ramp.scene), known.effects) + _of_light(ramp.scene, way)
    return fit_ramp(model, ramp.data, start_nm, _options(way, start_nm), effects)


def _of_light(scene: Scene, way: Way) -> list[Effect]:
    """What a way fits to the whole ramp."""
    conditions = conditions_of(scene, ncpa_wavelength_nm=bands.NARROW_H.centre_nm)
    colour: list[Effect] = []
    if way.colour:
        colour = [AtmosphericDispersion.under(conditions), star_colour(conditions)]
    if not way.last_noll:
        return colour
    chromatic, lens = (range(first, way.last_noll + 1) for first in (DEFOCUS, DEFOCUS + 1))
    fronts = [ChromaticNcpa.under(conditions, chromatic), FilterNcpa.under(conditions, lens)]
    return [*colour, *fronts]


def _options(way: Way, start_nm: torch.Tensor) -> LiftOptions:
    """A prior that holds tip and tilt where the way does."""
    if way.tilt == "free":
        return LiftOptions()
    sigma_nm = torch.full((len(way.modes),), torch.inf, dtype=torch.float64)
    mean_nm = start_nm.clone()
    for noll in TIP_TILT:
        sigma_nm[way.modes.index(noll)] = HELD_NM
        if way.tilt == "calibrated":
            mean_nm[:, way.modes.index(noll)] = 0.0
    return LiftOptions(prior_mean_nm=mean_nm, prior_sigma_nm=sigma_nm)
