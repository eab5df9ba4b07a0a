"""Calibrations of simulated cubes, published ones and the default with parts changed, and their errors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated

import numpy as np
from pydantic import Field

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL, REPORTED_NOLLS
from irlos_pipe.effects import Effect, FixedEffect, SeeingHalo
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_options import DEFAULT_METHOD, CalibrationOptions, HighestNoll
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.wavefront import modes_at, opd_maps_nm
from irlos_pipe.paper.common.observation import frames_of, model_effects_of, settings_of
from irlos_pipe.simulate.exposure import Exposed, expose
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.stages.calibrate.stage import Config as CalibrateConfig

DEFAULT = DEFAULT_METHOD
PAPER_CHOICE = "dip_global"
PUBLISHED = ("lift_avg", "dip_avg", "dip_joint", "lift_slices", PAPER_CHOICE)
METHOD_NAMES = {
    DEFAULT: "this pipeline's default", PAPER_CHOICE: "DIP global", "lift_slices": "LIFT slices",
    "dip_joint": "DIP joint", "lift_avg": "LIFT avg.", "dip_avg": "DIP avg.",
}  # fmt: skip


PublishedFrames = Annotated[
    int,
    Field(ge=2, le=10000, description="the first frames, for the published method, which fits one by one"),
]


def frames_per_method(frames: int, published_frames: int) -> dict[str, int]:
    """Return the frames of a cube that each of two methods is given.

    The default takes all `frames`; the paper's choice, which fits one by one, the first `published_frames`.
    """
    return {DEFAULT: frames, PAPER_CHOICE: min(frames, published_frames)}


# -- variants ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    label: str  # what it is, for tables
    options: CalibrationOptions = field(default_factory=CalibrationOptions)  # without the prior
    prior: bool = True  # whether the modes have the prior that the stage `calibrate` gives them
    # from the AO residual of the default to that of the variant; None for neither it nor jitter
    halo: Callable[[SeeingHalo], Effect] | None = lambda halo: halo
    frames: Callable[[Frames], Frames] = lambda frames: frames  # from the cube to the frames used

    def options_with(self, ncpa_law: NcpaLaw) -> CalibrationOptions:
        """Return the options, with the prior that the stage `calibrate` makes of `ncpa_law` if there is one.

        In simulations the NCPAs are drawn from the same law: the prior is the truth, widened.
        """
        prior = CalibrateConfig.model_validate({}).options(ncpa_law).prior if self.prior else None
        return replace(self.options, prior=prior)

    def with_modes(self, highest_noll: HighestNoll) -> "Variant":
        return replace(self, options=replace(self.options, highest_noll=highest_noll))

    def closed(self) -> "Variant":
        """Return the same in a closed basis: modes beyond are drawn to 0 by a law of each cube's own."""
        return self.with_modes(self.options.last_noll)


def partial_halo(halo: SeeingHalo, count: int) -> FixedEffect:
    """Return `halo` with its first `count` parameters free and the others, all of its direction, at zero."""
    starts, names = ([getattr(p, key) for p in halo.parameters] for key in ("start", "name"))
    return FixedEffect(halo, starts, free=names[:count])


def sharpest_half(frames: Frames) -> Frames:
    """Return half of the frames, by the normalised sum of squares (Muller & Buffington 1974)."""
    images = frames.images_e.double()
    sharpness = images.square().sum((1, 2)) / images.sum((1, 2)) ** 2
    sharpest = sharpness.topk(max(2, len(images) // 2)).indices.sort().values
    return replace(frames, images_e=frames.images_e[sharpest])


# The default first; then what each of its parts contributes. A method as published has 29 modes, its own
# loss, no prior, and no AO residual in the model.
VARIANTS = {
    DEFAULT: Variant("default: mean image, AO residual and jitter, open basis, prior"),
    "no_residual": Variant("without AO residual and jitter", halo=None),
    "expected_residual": Variant("AO residual held at the seeing law", halo=SeeingHalo.expected),
    "round_residual": Variant("AO residual without direction", halo=partial(partial_halo, count=2)),
    "elliptic_residual": Variant("AO residual with one axis only", halo=partial(partial_halo, count=4)),
    "few_modes": Variant("29 modes", CalibrationOptions(highest_noll=HIGHEST_REPORTED_NOLL)),
    "many_modes": Variant("104 modes", CalibrationOptions(highest_noll=105)),
    "no_prior": Variant("no prior of the modes", prior=False),
    "sharp_half": Variant("sharpest half of the frames", frames=sharpest_half),
    **{
        method: Variant(method, CalibrationOptions(method, highest_noll=HIGHEST_REPORTED_NOLL), prior=False)
        for method in PUBLISHED
    },
}


# -- cubes -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ObservedCube:
    """A simulated cube: what an observer has of it, and its truth."""

    scene: Scene
    exposed: Exposed  # noise-free images and wavefronts of all frames of the scene
    frames: Frames  # the noisy frames in use, the first ones of the scene

    @classmethod
    def of(cls, scene: Scene, exposed: Exposed | None = None) -> "ObservedCube":
        """Expose a scene, unless it is `exposed` already, and add the noise."""
        exposed = exposed or expose(scene)
        return cls(scene, exposed, frames_of(scene, exposed))

    @property
    def settings(self) -> PsfSettings:
        return settings_of(self.scene)

    @property
    def effects(self) -> list[Effect]:
        return model_effects_of(self.scene)

    def first(self, count: int) -> "ObservedCube":
        """Return the same cube with its first `count` frames only."""
        return replace(self, frames=replace(self.frames, images_e=self.frames.images_e[:count]))

    def dimmed(self, mag_j: float) -> "ObservedCube":
        """Return the same sky with a star of magnitude `mag_j` and noise of its own."""
        scene = replace(self.scene, mag_j=mag_j)
        factor = np.float32(scene.photons / self.scene.photons)
        return ObservedCube.of(scene, replace(self.exposed, mean_e=self.exposed.mean_e * factor))

    def calibrated(self, variant: Variant, further: Sequence[Effect] = ()) -> Calibration:
        """Estimate the NCPAs by one variant of the calibration, with `further` effects in the model."""
        halo, jitter = self.effects
        effects = [variant.halo(halo), jitter, *further] if variant.halo else [*further]  # type: ignore[arg-type]
        options = variant.options_with(self.scene.facility.ncpa_law)
        return calibrate(variant.frames(self.frames), self.settings, options, effects)

    def introduced_wfe_nm(self) -> float:
        """Return the RMS over the pupil of the time-averaged wavefront without diversity [nm]."""
        return self._rms(self.exposed.mean_opd_nm[self._lit])

    def pupil_delta_nm(self, calibration: Calibration) -> float:
        """Return Δ-WFE over the full pupil: RMS of true minus estimated wavefront, piston removed [nm].

        The truth is the time-averaged wavefront of all frames, diversity excluded.
        """
        estimated_nm = calibration.zernike_nm @ modes_at(calibration.nolls, self._lit)
        return self._rms(self.exposed.mean_opd_nm[self._lit] - estimated_nm)

    def modes_delta_nm(self, calibration: Calibration) -> float:
        """Return Δ-WFE in Noll 2–30 against the mean wavefront of the frames in use [nm RMS]."""
        used = self.exposed.zernike_nm[: len(self.frames.images_e)]
        true_nm = used.mean(axis=0)[: len(REPORTED_NOLLS)]
        given_nm = dict(zip(calibration.nolls, calibration.zernike_nm, strict=True))
        difference_nm = true_nm - np.array([given_nm.get(noll, 0.0) for noll in REPORTED_NOLLS])
        return self._rms(difference_nm @ modes_at(REPORTED_NOLLS, self._lit))

    def error_nm(self, variant: Variant) -> float:
        """Return `modes_delta_nm` of a calibration by a variant."""
        return self.modes_delta_nm(self.calibrated(variant))

    def wavefront_nm(self, calibration: Calibration) -> np.ndarray:
        """Return the estimated wavefront on the simulator's pupil grid, (n, n); NaN outside the pupil."""
        return opd_maps_nm(calibration.nolls, calibration.zernike_nm, self._lit)

    @property
    def _lit(self) -> np.ndarray:
        return self.exposed.transmission > 0

    def _rms(self, values: np.ndarray) -> float:
        return weighted_rms(values, self.exposed.transmission[self._lit])


def weighted_rms(values: np.ndarray, weight: np.ndarray) -> float:
    """Return the RMS of `values` about their mean, weighted by `weight`."""
    mean = np.average(values, weights=weight)
    return float(np.sqrt(np.average((np.asarray(values) - mean) ** 2, weights=weight)))
