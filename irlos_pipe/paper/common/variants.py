"""Variants of the calibration: the published methods, the default, and the default with parts changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.effects import Effect, FixedEffect, SeeingHalo, expected
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_options import DEFAULT_METHOD, CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.stages.calibrate.stage import Config as CalibrateConfig

DEFAULT = DEFAULT_METHOD
PAPER_CHOICE = "dip_global"
PUBLISHED = ("lift_avg", "dip_avg", "dip_joint", "lift_slices", PAPER_CHOICE)
METHOD_NAMES = {
    DEFAULT: "this pipeline's default",
    PAPER_CHOICE: "DIP global",
    "lift_slices": "LIFT slices",
    "dip_joint": "DIP joint",
    "lift_avg": "LIFT avg.",
    "dip_avg": "DIP avg.",
}

Effects = Sequence[Effect]


def frames_per_method(frames: int, published_frames: int) -> dict[str, int]:
    """Return the frames of a cube of `frames` that each of two methods is given.

    The default takes all of them; the paper's choice, which fits frame by frame, the first
    `published_frames`.
    """
    return {DEFAULT: frames, PAPER_CHOICE: min(frames, published_frames)}


def partial_halo(halo: SeeingHalo, count: int) -> FixedEffect:
    """Return `halo` with its first `count` parameters free and the others, all of its direction, at zero."""
    starts, names = ([getattr(p, key) for p in halo.parameters] for key in ("start", "name"))
    return FixedEffect(halo, starts, free=names[:count])


@dataclass(frozen=True)
class Variant:
    """One way to calibrate a cube.

    Attributes
    ----------
    label : str
        What it is, for tables.
    options : CalibrationOptions
        Without the prior.
    prior : bool
        Whether the modes have the prior that the stage `calibrate` gives them.
    effects : callable
        From the default's effects to those of the variant.
    frames : callable
        From the cube to the frames used.
    """

    label: str
    options: CalibrationOptions = field(default_factory=CalibrationOptions)
    prior: bool = True
    effects: Callable[[Effects], Effects] = list
    frames: Callable[[Frames], Frames] = lambda frames: frames

    def options_with(self, ncpa_law: NcpaLaw) -> CalibrationOptions:
        """Return the options, with the prior that the stage `calibrate` makes of `ncpa_law` if there is one.

        In simulations the NCPAs are drawn from the same law: the prior is the truth, widened.
        """
        prior = CalibrateConfig.model_validate({}).options(ncpa_law).prior if self.prior else None
        return replace(self.options, prior=prior)

    def closed(self) -> Variant:
        """Return the same in a closed basis: modes beyond are drawn to 0 by a law of each cube's own."""
        return replace(self, options=replace(self.options, highest_noll=self.options.last_noll))

    def calibrate(
        self, frames: Frames, settings: PsfSettings, effects: Effects, ncpa_law: NcpaLaw
    ) -> Calibration:
        """Estimate the NCPAs of a cube.

        Parameters
        ----------
        frames : Frames
        settings : PsfSettings
        effects : sequence of Effect
            Those of the default.
        ncpa_law : NcpaLaw
            Of the prior.
        """
        return calibrate(self.frames(frames), settings, self.options_with(ncpa_law), self.effects(effects))


def _published(method: str) -> Variant:
    """A method as published: 29 modes, its own loss, no prior, no AO residual in the model."""
    return Variant(method, CalibrationOptions(method, highest_noll=HIGHEST_REPORTED_NOLL), prior=False)


def _partial(effects: Effects, count: int) -> Effects:
    return [partial_halo(effect, count) if isinstance(effect, SeeingHalo) else effect for effect in effects]


def _expected_residual(effects: Effects) -> Effects:
    return [expected([effect])[0] if isinstance(effect, SeeingHalo) else effect for effect in effects]


def sharpest_half(frames: Frames) -> Frames:
    """Return half of the frames, by the normalised sum of squares (Muller & Buffington 1974)."""
    images = frames.images_e.double()
    sharpness = images.square().sum((1, 2)) / images.sum((1, 2)) ** 2
    sharpest = sharpness.topk(max(2, len(images) // 2)).indices.sort().values
    return replace(frames, images_e=frames.images_e[sharpest])


# The default first; then what each of its parts contributes.
VARIANTS = {
    DEFAULT: Variant("default: mean image, AO residual and jitter, open basis, prior"),
    "no_residual": Variant("without AO residual and jitter", effects=lambda effects: []),
    "expected_residual": Variant("AO residual held at the seeing law", effects=_expected_residual),
    "round_residual": Variant("AO residual without direction", effects=partial(_partial, count=2)),
    "elliptic_residual": Variant("AO residual with one axis only", effects=partial(_partial, count=4)),
    "few_modes": Variant("29 modes", CalibrationOptions(highest_noll=HIGHEST_REPORTED_NOLL)),
    "many_modes": Variant("104 modes", CalibrationOptions(highest_noll=105)),
    "no_prior": Variant("no prior of the modes", prior=False),
    "sharp_half": Variant("sharpest half of the frames", frames=sharpest_half),
    **{method: _published(method) for method in PUBLISHED},
}
