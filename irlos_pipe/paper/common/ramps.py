"""Focus ramps: the variants of LIFT that are compared, and LIFT on a simulated ramp."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.effects import Effect, FixedEffect, expected, fixed_optics
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate import ramp_fit
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.elongation import axis_ratios, calibrate_law
from irlos_pipe.estimate.lift import LiftResult, lift
from irlos_pipe.estimate.ramp_fit import RampData, RampFit, fit_ramp, ramp_effects, start_from_defocus
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.numerics.loss import LossName
from irlos_pipe.optics.light_path import LightPath
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper.common import observation
from irlos_pipe.paper.common.calibrations import DEFAULT, PAPER_CHOICE, VARIANTS, ObservedCube
from irlos_pipe.paper.common.scenes import FINE, star_scene
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.stages.base import StageConfig

TTF = (2, 3, 4)
NINE = (2, 3, 4, 5, 7, 8, 9, 10, 11)  # the paper's nine modes: without the astigmatism of the diversity
KERNEL_MAS = 12.0  # σ_obj of the paper's first target
RAMP_STREAM = 1  # child of a sample's seed: residuals of the ramp are not those of the cube


@dataclass(frozen=True)
class LiftVariant:
    name: str
    modes: tuple[int, ...] = TTF  # Noll
    ncpa: str = ""  # calibration method whose NCPAs are known; empty for none
    halo: Literal["calibrated", "off"] = "calibrated"  # AO residual in the model
    kernel: str | float = "calibrated"  # of object and jitter: "calibrated", "fit", or its sigma [mas]
    loss: LossName = "gaussian"  # "l1" is that of the paper's DIP


# The kernel is fixed by hand as in the paper, or fitted to the ramp; the default takes what it calibrated.
_BY_HAND = LiftVariant("NCPAs by DIP global, kernel 12 mas", TTF, PAPER_CHOICE, "off", KERNEL_MAS)
_BASE = {
    "none": replace(_BY_HAND, name="no NCPAs, kernel 12 mas", ncpa=""),
    "none_residual": LiftVariant("no NCPAs, AO residual expected"),
    "published": _BY_HAND,
    "published_fit": replace(_BY_HAND, name="NCPAs by DIP global, kernel fitted", kernel="fit"),
    "published_l1": replace(_BY_HAND, name=f"{_BY_HAND.name}, DIP's loss", loss="l1"),
    "default_l1": LiftVariant("default, DIP's loss", ncpa=DEFAULT, loss="l1"),
    "default": LiftVariant("default: NCPAs, AO residual, jitter as calibrated", ncpa=DEFAULT),
}
LIFT_VARIANTS = {
    f"{key}_{len(modes)}": replace(variant, modes=modes)
    for key, variant in _BASE.items()
    for modes in (TTF, NINE)
}


# -- what is known -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Knowledge:
    """What a calibration hands on to LIFT; nothing by default."""

    ncpa_nm: Mapping[int, float] = field(default_factory=dict)  # Noll: nm RMS
    # AO residual and jitter as measured; empty for methods without them in their model
    effects: Mapping[str, FixedEffect] = field(default_factory=dict)


def knowledge_of(cube: ObservedCube, calibration: Calibration) -> Knowledge:
    """Return what a `calibration` of a `cube` hands on."""
    ncpa_nm = dict(zip(calibration.nolls, calibration.fitted_modes_nm.tolist(), strict=True))
    effects = {
        effect.name: FixedEffect(effect, calibration.effect_values[effect.name].tolist())
        for effect in cube.effects
        if effect.name in calibration.effect_values
    }
    return Knowledge(ncpa_nm, effects)


def calibrated(scene: Scene, methods: Iterable[str]) -> dict[str, Knowledge]:
    """Return what each of the `methods` learns from a cube: simulate `scene` and calibrate it."""
    requested = [method for method in dict.fromkeys(methods) if method]
    if not requested:
        return {}
    cube = ObservedCube.of(scene)
    return {method: knowledge_of(cube, cube.calibrated(VARIANTS[method])) for method in requested}


# -- the ramp ----------------------------------------------------------------------------------------


class RampSizes(StageConfig):
    """Sizes of ramps in J and H and of the cubes that they are calibrated with."""

    reach_nm: float = Field(300.0, gt=0, le=600, description="a ramp goes from minus to plus this [nm RMS]")
    offsets: int = Field(13, ge=3, le=200, description="positions of a ramp")
    frames_per_offset: int = Field(2, ge=1, le=1000, description="frames at every position")
    cube_frames: int = Field(300, ge=10, le=10000, description="frames of the calibration cube")
    seeing_arcsec: float = Field(0.35, gt=0, le=3, description="seeing on SPARTA's scale")
    cube_mag_j: float = Field(7.0, ge=0, le=20, description="J magnitude in the calibration cube")
    ramp_mag_j: float = Field(12.0, ge=0, le=20, description="J magnitude in the ramps in J and H")

    @property
    def introduced_nm(self) -> tuple[float, ...]:
        return offsets_nm(self.reach_nm, self.offsets, self.frames_per_offset)

    @property
    def of_cube(self) -> tuple[float, int, float]:
        """Seeing, frames and magnitude of the calibration cube."""
        return self.seeing_arcsec, self.cube_frames, self.cube_mag_j


def offsets_nm(reach_nm: float, offsets: int, frames: int = 1) -> tuple[float, ...]:
    """Return the defocus of every frame of a ramp from minus to plus `reach_nm`, `frames` at each offset."""
    return tuple(np.repeat(np.linspace(-reach_nm, reach_nm, offsets), frames).tolist())


def ramp_scene(cube: Scene, mag_j: float, introduced_nm: Sequence[float], **changes: Any) -> Scene:
    """Return a ramp of frames of a second with the NCPAs of a calibration `cube` and other residuals.

    The star has magnitude `mag_j`; `introduced_nm` is the defocus of every frame [nm RMS].
    """
    seed, seeing = (*cube.seed, RAMP_STREAM), observation.seeing_of(cube)
    of_frames = len(introduced_nm), mag_j, cube.ncpa_nm, tuple(introduced_nm)
    ramp = star_scene(cube.name, cube.facility, seed, *of_frames, seeing_arcsec=seeing)
    return replace(ramp, **{"sampling": FINE} | changes)


def narrow_ramp(cube: Scene, exposure_s: float, introduced_nm: tuple[float, ...], *stream: int) -> Scene:
    """Return a ramp of the star of a `cube` in its light, in frames of `exposure_s` without a gap.

    `introduced_nm` is as of `ramp_scene`; one `stream` gives other residuals than another.
    """
    return replace(
        cube, role="defocus_ramp", seed=(*cube.seed, RAMP_STREAM, *stream), frames=len(introduced_nm),
        exposure_s=exposure_s, frame_rate_hz=1 / exposure_s, introduced_nm=introduced_nm,
    )  # fmt: skip


def elongation_defocus_nm(scene: Scene, data: RampData) -> np.ndarray:
    """Return the defocus of every frame of `data`, (frames,), from the elongation of its image.

    The law comes from the model of `scene`.
    """
    model = PsfModel(observation.settings_of(scene), [DEFOCUS])
    law = calibrate_law(model, fixed_optics(expected(observation.model_effects_of(scene)), model.grids))
    return law.defocus_nm(axis_ratios(data.images_e, data.good, law.angle_deg))


@dataclass(frozen=True)
class ObservedRamp:
    """A ramp and what is known when it is estimated."""

    scene: Scene
    exposed: Exposed  # without noise
    data: RampData
    prior_nm: np.ndarray  # of the whole defocus, NCPAs included, from the elongation, (frames,)
    knowledge: Mapping[str, Knowledge]  # by calibration method; nothing under the empty name

    @property
    def true_nm(self) -> np.ndarray:
        """Return Noll 2–11 of the mean wavefront of every frame, (frames, 10) [nm RMS].

        NCPAs, AO residual and introduced defocus.
        """
        true_nm = self.exposed.zernike_nm[:, :10].copy()
        true_nm[:, DEFOCUS - 2] += self.data.introduced_nm
        return true_nm

    def model(self, variant: LiftVariant) -> PsfModel:
        """Return the PSF model of a variant with the NCPAs that it knows."""
        return PsfModel(observation.frame_settings(self.scene, self.given_nm(variant)), variant.modes)

    def effects(self, variant: LiftVariant) -> list[Effect]:
        """Return AO residual and kernel of a variant."""
        known = self.knowledge[variant.ncpa].effects
        of_scene = observation.model_effects_of(self.scene)
        return ramp_effects(of_scene, known, variant.halo, variant.kernel)

    def start_nm(self, variant: LiftVariant, model: LightPath) -> torch.Tensor:
        """Return the start of `variant` with its `model` from the elongation prior, (frames, modes)."""
        given_nm = self.given_nm(variant).get(DEFOCUS, 0.0)
        return start_from_defocus(model, self.data, self.prior_nm - given_nm)

    def given_nm(self, variant: LiftVariant) -> Mapping[int, float]:
        """Return the NCPAs that a variant knows, Noll: nm RMS."""
        return self.knowledge[variant.ncpa].ncpa_nm

    def estimate(self, variant: LiftVariant) -> RampFit:
        model, options = self.model(variant), LiftOptions(loss=variant.loss)
        return fit_ramp(model, self.data, self.start_nm(variant, model), options, self.effects(variant))

    def modes_nm(self, variant: LiftVariant, fit: RampFit) -> np.ndarray:
        """Return all that was found, the NCPAs that were given included, (frames, modes)."""
        given_nm = self.given_nm(variant)
        return fit.result.zernike_nm.numpy() + [given_nm.get(noll, 0.0) for noll in variant.modes]


def observe(scene: Scene, knowledge: Mapping[str, Knowledge]) -> ObservedRamp:
    """Return a ramp with its noise, its elongation prior, and what is known of it."""
    exposed, good = expose(scene), torch.ones(scene.window, dtype=torch.bool)
    images, noise = observation.images_of(scene, exposed), observation.noise_of(scene)
    data = RampData(images, good, noise, scene.introduced_per_frame_nm.copy())
    prior_nm = elongation_defocus_nm(scene, data)
    return ObservedRamp(scene, exposed, data, prior_nm, {"": Knowledge()} | dict(knowledge))


def from_every_start(
    model: ImageModel, data: RampData, elongation_nm: torch.Tensor, options: LiftOptions
) -> dict[str, tuple[torch.Tensor, LiftResult]]:
    """Return starts and estimates of a ramp: from zero, the elongation prior, and the scan of defocus.

    `elongation_nm`, (frames, modes), is the second of these [nm RMS]; ``default`` is it with a second try of
    outlying frames from the scan.
    """
    starts = {
        "zero": start_from_defocus(model.psf, data, np.zeros(len(data.images_e))),
        "elongation": elongation_nm,
        "scan": scan_start_nm(model.psf, data.images_e, data.good, model.optics),
    }
    found = {
        name: (start, lift(model, data.images_e, data.good, data.noise, start, options))
        for name, start in starts.items()
    }
    start, result = found["elongation"]
    return found | {"default": (start, ramp_fit.second_try(model, data, result, options))}
