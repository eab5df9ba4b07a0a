"""Physical effects beyond the static wavefront, each declaring where on the light path it acts."""

from irlos_pipe.effects.base import Effect, FixedEffect, expected
from irlos_pipe.effects.catalogue import CATALOGUE, everyday, in_other_forms
from irlos_pipe.effects.declaration import Calibrated, Conditions, Parameter, Public
from irlos_pipe.effects.effect_set import EffectSet, fixed_optics
from irlos_pipe.effects.motion import TipTiltJitter
from irlos_pipe.effects.seeing_halo import SeeingHalo

__all__ = [
    "CATALOGUE", "Calibrated", "Conditions", "Effect", "EffectSet", "FixedEffect", "Parameter", "Public",
    "SeeingHalo", "TipTiltJitter", "everyday", "expected", "fixed_optics", "in_other_forms",
]  # fmt: skip
