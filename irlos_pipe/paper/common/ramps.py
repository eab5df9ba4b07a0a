"""Focus ramps: the order of recording, the ways to estimate them, and LIFT on a simulated one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch

from irlos_pipe.effects import Effect, FixedEffect, expected, fixed_optics
from irlos_pipe.estimate.calibration import Calibration
from irlos_pipe.estimate.elongation import axis_ratios, calibrate_law
from irlos_pipe.estimate.lift import LiftOptions
from irlos_pipe.estimate.ramp_fit import RampData, RampFit, fit_ramp, ramp_effects, start_from_defocus
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.paper.common.broad_band import frame_settings
from irlos_pipe.paper.common.observation import frames_of, images_of, model_effects_of, noise_of, settings_of
from irlos_pipe.paper.common.variants import VARIANTS
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.scene import Scene

DEFOCUS = 4  # Noll
TTF = (2, 3, 4)
NINE = (2, 3, 4, 5, 7, 8, 9, 10, 11)  # the paper's nine modes: without the astigmatism of the diversity


@dataclass(frozen=True)
class Way:
    """One way to estimate a ramp.

    Attributes
    ----------
    modes : tuple of int
        Noll.
    ncpa : str
        Calibration method whose NCPAs are added to the diversity; empty for none.
    halo : {"calibrated", "off"}
        AO residual in the model.
    kernel : {"calibrated", "fit"} or float
        Gaussian kernel of object and jitter, fixed ones in mas.
    """

    name: str
    modes: tuple[int, ...]
    ncpa: str = ""
    halo: Literal["calibrated", "off"] = "calibrated"
    kernel: str | float = "calibrated"


@dataclass(frozen=True)
class Knowledge:
    """What a calibration hands on to LIFT; nothing by default.

    Attributes
    ----------
    ncpa_nm : dict of int to float
        Noll: nm RMS.
    effects : dict of str to FixedEffect
        AO residual and jitter as measured; empty for methods without them in their model.
    """

    ncpa_nm: Mapping[int, float] = field(default_factory=dict)
    effects: Mapping[str, FixedEffect] = field(default_factory=dict)


def knowledge_of(scene: Scene, calibration: Calibration) -> Knowledge:
    """NCPAs and effects of a calibration of `scene`."""
    ncpa_nm = dict(zip(calibration.nolls, calibration.fitted_modes_nm.tolist(), strict=True))
    effects = {
        effect.name: FixedEffect(effect, calibration.effect_values[effect.name])
        for effect in model_effects_of(scene)
        if effect.name in calibration.effect_values
    }
    return Knowledge(ncpa_nm, effects)


def ramp_data(scene: Scene, exposed: Exposed) -> RampData:
    """Noisy frames of a ramp with the defocus that the focus stage was told to introduce."""
    good = torch.ones(scene.window, dtype=torch.bool)
    return RampData(images_of(scene, exposed), good, noise_of(scene), scene.introduced_per_frame_nm.copy())


def elongation_defocus_nm(scene: Scene, data: RampData) -> np.ndarray:
    """Defocus of every frame from the elongation of its image, (frames,), the law from the model."""
    model = PsfModel(settings_of(scene), [DEFOCUS])
    law = calibrate_law(model, fixed_optics(expected(model_effects_of(scene)), model.grids))
    return law.defocus_nm(axis_ratios(data.images_e, data.pixel_mask, law.angle_deg))


@dataclass(frozen=True)
class ObservedRamp:
    """A ramp and what is known when it is estimated.

    Attributes
    ----------
    scene : Scene
    data : RampData
    prior_nm : ndarray, (frames,)
        Of the whole defocus, NCPAs included, from the elongation.
    knowledge : mapping of str to Knowledge
        By calibration method; nothing under the empty name.
    """

    scene: Scene
    data: RampData
    prior_nm: np.ndarray
    knowledge: Mapping[str, Knowledge]

    def model(self, way: Way) -> PsfModel:
        """PSF model of a way, the NCPAs it knows added to the diversity."""
        return PsfModel(frame_settings(self.scene, self.knowledge[way.ncpa].ncpa_nm), way.modes)

    def effects(self, way: Way) -> list[Effect]:
        """AO residual and kernel of a way."""
        known = self.knowledge[way.ncpa].effects
        return ramp_effects(model_effects_of(self.scene), known, way.halo, way.kernel)

    def start_nm(self, way: Way, model: PsfModel) -> torch.Tensor:
        """Start from the elongation prior, (frames, modes)."""
        return start_from_defocus(model, self.data, self.prior_nm - self.given_defocus_nm(way))

    def given_defocus_nm(self, way: Way) -> float:
        """Defocus among the NCPAs that a way adds to the diversity."""
        return self.knowledge[way.ncpa].ncpa_nm.get(DEFOCUS, 0.0)

    def estimate(self, way: Way) -> RampFit:
        """LIFT of all frames."""
        model = self.model(way)
        return fit_ramp(model, self.data, self.start_nm(way, model), LiftOptions(), self.effects(way))


def observe(scene: Scene, exposed: Exposed, knowledge: Mapping[str, Knowledge]) -> ObservedRamp:
    """Frames of a simulated ramp and their elongation prior."""
    data = ramp_data(scene, exposed)
    return ObservedRamp(scene, data, elongation_defocus_nm(scene, data), {"": Knowledge()} | dict(knowledge))


def calibrated(cube: Scene, methods: Sequence[str]) -> dict[str, Knowledge]:
    """What each method learns from a cube: simulate and calibrate it."""
    frames = frames_of(cube, expose(cube))
    return {
        method: knowledge_of(
            cube,
            VARIANTS[method].calibrate(
                frames, settings_of(cube), model_effects_of(cube), cube.facility.ncpa_law
            ),
        )
        for method in methods
    }


def ping_pong(offsets_nm: Sequence[float]) -> np.ndarray:
    """Offsets from the ends inwards, from one side to the other after every step."""
    ordered = np.sort(np.asarray(offsets_nm, float))
    inwards = np.stack([ordered, ordered[::-1]], axis=1).ravel()
    return inwards[: len(ordered)]
