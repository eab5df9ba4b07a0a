"""Ways to calibrate one cube: the published ones, the default, and the default with parts changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.effects import Effect, FixedEffect, SeeingHalo, expected
from irlos_pipe.estimate.calibration import Calibration, CalibrationOptions, calibrate
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.stages.calibrate.stage import Config as CalibrateConfig

DEFAULT = "long_exposure"
PUBLISHED = ("lift_avg", "dip_avg", "dip_joint", "lift_slices", "dip_global")
PUBLISHED_MODES = 30  # Noll 2 to this, as SPARTA can correct

Effects = Sequence[Effect]


def partial_halo(halo: SeeingHalo, count: int) -> FixedEffect:
    """AO residual with its first `count` parameters free and the others, all of its direction, at zero."""
    starts, names = ([getattr(p, key) for p in halo.parameters] for key in ("start", "name"))
    return FixedEffect(halo, starts, free=names[:count])


@dataclass(frozen=True)
class Variant:
    """One way to calibrate.

    Attributes
    ----------
    label : str
        What it is, for tables.
    options : CalibrationOptions
    effects : callable
        From the default's effects to those of the variant.
    frames : callable
        From the cube to the frames used.
    prior : bool
        Whether the modes have the prior that the stage `calibrate` gives them.
    """

    label: str
    options: CalibrationOptions = field(default_factory=CalibrationOptions)
    effects: Callable[[Effects], Effects] = list
    frames: Callable[[Frames], Frames] = lambda frames: frames
    prior: bool = True

    def calibrate(
        self, frames: Frames, settings: PsfSettings, effects: Effects, ncpa_law: NcpaLaw
    ) -> Calibration:
        """Estimate the NCPAs of the cube `frames` this way.

        `settings` and `effects` make the model, and `ncpa_law` is that of the prior.
        """
        options = with_prior(self.options, ncpa_law) if self.prior else self.options
        return calibrate(self.frames(frames), settings, options, self.effects(effects))


def with_prior(options: CalibrationOptions, ncpa_law: NcpaLaw) -> CalibrationOptions:
    """The `options` with the prior that the stage `calibrate` makes of `ncpa_law`."""
    return replace(options, prior=CalibrateConfig().options(ncpa_law).prior)


def published(method: str) -> Variant:
    """A method as published: 29 modes, its own loss, no prior, no AO residual in the model."""
    return Variant(method, CalibrationOptions(method=method, highest_noll=PUBLISHED_MODES), prior=False)


def _partial(effects: Effects, count: int) -> Effects:
    return [partial_halo(effect, count) if isinstance(effect, SeeingHalo) else effect for effect in effects]


def _expected_residual(effects: Effects) -> Effects:
    return [expected([effect])[0] if isinstance(effect, SeeingHalo) else effect for effect in effects]


def sharpest_half(frames: Frames) -> Frames:
    """Half of the frames, by the normalised sum of squares (Muller & Buffington 1974)."""
    images = frames.images_e.double()
    sharpness = images.square().sum((1, 2)) / images.sum((1, 2)) ** 2
    sharpest = sharpness.topk(max(2, len(images) // 2)).indices.sort().values
    return replace(frames, images_e=frames.images_e[sharpest])


# The default first; then what each of its parts buys.
VARIANTS = {
    DEFAULT: Variant("default: mean image, AO residual and jitter, 65 modes, prior"),
    "no_residual": Variant("without AO residual and jitter", effects=lambda effects: []),
    "expected_residual": Variant("AO residual held at the seeing law", effects=_expected_residual),
    "round_residual": Variant("AO residual without direction", effects=partial(_partial, count=2)),
    "elliptic_residual": Variant("AO residual with one axis only", effects=partial(_partial, count=4)),
    "few_modes": Variant("29 modes", CalibrationOptions(highest_noll=PUBLISHED_MODES)),
    "many_modes": Variant("104 modes", CalibrationOptions(highest_noll=105)),
    "no_prior": Variant("no prior of the modes", prior=False),
    "sharp_half": Variant("sharpest half of the frames", frames=sharpest_half),
    **{method: published(method) for method in PUBLISHED},
}
