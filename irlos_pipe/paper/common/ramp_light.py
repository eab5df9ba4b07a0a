"""What the light of a ramp may have that its calibration did not show, and the ways to estimate it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch

from irlos_pipe.conventions import bands
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.modes import DEFOCUS, TIP_TILT
from irlos_pipe.effects import Effect
from irlos_pipe.effects.chromatic import ChromaticNcpa, FilterNcpa
from irlos_pipe.effects.colour import AtmosphericDispersion
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampFit, fit_ramp
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper.common.calibrations import DEFAULT
from irlos_pipe.paper.common.observation import conditions_of, settings_of
from irlos_pipe.paper.common.ramps import NINE, TTF, LiftVariant, ObservedRamp
from irlos_pipe.simulate.ncpa import draw_ncpa_nm
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.stages.model.effects import star_colour

CHROMATIC_STREAM, FILTER_STREAM = 2, 3  # children of a sample's seed, next to that of the ramp
WAVEFRONT_MODES = 50  # as many as the NCPAs have
HELD_NM = 1e-3  # width of a prior that fixes a parameter
ASKED_NM = 4.0


@dataclass(frozen=True)
class Way(LiftVariant):
    """One way to estimate a ramp, with AO residual and jitter as calibrated or expected.

    With `colour`, dispersion and the slope of the star's spectrum are fitted to all frames together, and up
    to `last_noll` the wavefront of the lens and the one that changes with wavelength. `tilt` of every frame
    is estimated, or held.
    """

    ncpa: str = DEFAULT
    colour: bool = True
    last_noll: int = 0
    tilt: Literal["free", "calibrated", "centroid"] = "free"


WAYS = {
    "default": Way("default: dispersion and colour fitted"),
    "wavefronts": Way("chromatic and lens's wavefront fitted too, to Noll 66", last_noll=66),
    "low_wavefronts": Way("the same, to Noll 21", last_noll=21),
    "plain": Way("neither dispersion nor colour", colour=False),
    "nine": Way("default, nine modes", NINE),
    "astigmatism": Way("default, Noll 6 free", (*TTF, 6)),
    "nine_astigmatism": Way("default, nine modes and Noll 6", tuple(sorted((*NINE, 6)))),
    "tilt_calibrated": Way("default, tip and tilt as calibrated", tilt="calibrated"),
    "tilt_centroid": Way("default, tip and tilt of the centroid", tilt="centroid"),
    "plain_nine": Way("nine modes", NINE, colour=False),
    "uncalibrated": Way("without NCPAs", ncpa="", colour=False),
    "uncalibrated_nine": Way("without NCPAs, nine modes", NINE, ncpa="", colour=False),
}


@dataclass(frozen=True)
class Condition:
    """What is true of a ramp and of no calibration in a narrow band, and the ways in which it is estimated.

    `chromatic_nm` is the wavefront between the centres of J and H, `filter_nm` that of the lens of the ramp
    [nm RMS]; `colour_per_um` the relative slope of the star's photons beyond that which is assumed.
    `asked_nm` is the error of the defocus asked of the first way. A ramp in ``narrow H`` is by the mirror.
    """

    label: str
    ways: tuple[str, ...]
    asked_nm: float | None = ASKED_NM
    bands: Literal["J+H", "narrow H"] = "J+H"
    chromatic_nm: float = 0.0
    filter_nm: float = 0.0
    dispersion_mas_per_um: float = 0.0
    angle_deg: float = 0.0
    colour_per_um: float = 0.0


COLOURS, FRONTS, NARROW_WAYS = ("default", "plain"), ("wavefronts", "default"), ("plain", *list(WAYS)[-3:])
BOTH_FRONTS: dict[str, Any] = {"chromatic_nm": 60.0, "filter_nm": 30.0}
DISPERSED: dict[str, Any] = {"dispersion_mas_per_um": 100.0, "angle_deg": 45.0}
CONDITIONS = {
    "clean": Condition("nothing", ("default", "plain", "wavefronts", *list(WAYS)[4:9], *list(WAYS)[-2:])),
    "chromatic_30": Condition("chromatic NCPAs of 30 nm", FRONTS, chromatic_nm=30.0),
    "chromatic_60": Condition("chromatic NCPAs of 60 nm", FRONTS, chromatic_nm=60.0),
    "filter_30": Condition("lens of 30 nm", FRONTS, filter_nm=30.0),
    "chromatic_60_filter_30": Condition(
        "chromatic NCPAs of 60 nm, lens of 30 nm", ("wavefronts", "low_wavefronts", "default"), **BOTH_FRONTS
    ),
    **{
        f"dispersion_{size}_at_{angle}": Condition(
            f"dispersion of {size} mas/µm at {angle}°", COLOURS, dispersion_mas_per_um=size, angle_deg=angle
        )
        for size, angle in ((50, 0), (50, 45), (100, 0), (100, 45), (100, 90))
    },
    "redder": Condition("star redder by 0.5 per µm", COLOURS, colour_per_um=0.5),
    "bluer": Condition("star bluer by 0.5 per µm", COLOURS, colour_per_um=-0.5),
    "all": Condition(
        "60 nm chromatic, lens 30 nm, 100 mas/µm at 45°, redder", FRONTS, **BOTH_FRONTS, **DISPERSED,
        colour_per_um=0.5,
    ),
    "narrow_h": Condition("narrow H alone, 0.1 s, by the mirror", NARROW_WAYS, None, "narrow H"),
}  # fmt: skip


def effects_of(
    condition: Condition, seed: tuple[int, ...], facility: Facility
) -> dict[str, Mapping[str, Any]]:
    """Return the simulator's effects of a condition, by name."""

    def drawn_nm(stream: int, first: int, total_nm: float) -> dict[int, float]:
        """A wavefront by the law of the NCPAs from Noll `first` on, of `total_nm` RMS.

        Tip and tilt of the colours are dispersion, and the focus of a lens is that of the star.
        """
        rng = np.random.default_rng((*seed, stream))
        drawn = draw_ncpa_nm(rng, facility.ncpa_law, 1.0, WAVEFRONT_MODES)
        kept = {noll: value for noll, value in drawn.items() if noll >= first}
        norm = float(np.linalg.norm(list(kept.values())))
        return {noll: value * total_nm / norm for noll, value in kept.items()}

    found: dict[str, Mapping[str, Any]] = {}
    if condition.chromatic_nm:
        per_um = condition.chromatic_nm / (bands.H.centre_nm - bands.J.centre_nm) * 1e3
        slopes = drawn_nm(CHROMATIC_STREAM, DEFOCUS, per_um)
        found["chromatic_ncpa"] = {"zernike_nm_per_um": slopes, "reference_nm": bands.NARROW_H.centre_nm}
    if condition.filter_nm:
        found["filter_ncpa"] = {"zernike_nm": drawn_nm(FILTER_STREAM, DEFOCUS + 1, condition.filter_nm)}
    if condition.dispersion_mas_per_um:
        vector = {"mas_per_um": condition.dispersion_mas_per_um, "angle_deg": condition.angle_deg}
        found["atmospheric_dispersion"] = vector
    if condition.colour_per_um:
        found["spectrum"] = {"slope": condition.colour_per_um}
    return found


def fit_way(ramp: ObservedRamp, way: Way) -> RampFit:
    """Estimate all frames of a ramp in one way, with the model and the sampling of the stage `lift`."""
    model = PsfModel(settings_of(ramp.scene, ramp.given_nm(way)).for_single_frames(), way.modes)
    start_nm = ramp.start_nm(way, model)
    options = LiftOptions()
    if way.tilt != "free":
        sigma_nm = torch.full((len(way.modes),), torch.inf, dtype=torch.float64)
        mean_nm = start_nm.clone()
        for place in map(way.modes.index, TIP_TILT):
            sigma_nm[place] = HELD_NM
            if way.tilt == "calibrated":
                mean_nm[:, place] = 0.0
        options = replace(options, prior_mean_nm=mean_nm, prior_sigma_nm=sigma_nm)
    effects = ramp.effects(way) + _of_light(ramp.scene, way)
    return fit_ramp(model, ramp.data, start_nm, options, effects)


def _of_light(scene: Scene, way: Way) -> list[Effect]:
    """What a way fits to the whole ramp."""
    conditions = conditions_of(scene, ncpa_wavelength_nm=bands.NARROW_H.centre_nm)
    colour = [AtmosphericDispersion.under(conditions), star_colour(conditions)] if way.colour else []
    if not way.last_noll:
        return colour
    chromatic, lens = (range(first, way.last_noll + 1) for first in (DEFOCUS, DEFOCUS + 1))
    return [*colour, ChromaticNcpa.under(conditions, chromatic), FilterNcpa.under(conditions, lens)]
