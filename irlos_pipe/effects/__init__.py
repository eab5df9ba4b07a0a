"""Physical effects beyond the static wavefront, each declaring where on the light path it acts."""

from .base import Conditions, Effect, Parameter
from .effect_set import EffectSet, fixed_optics
from .motion import TipTiltJitter, Vibration
from .pinned import Pinned, expected
from .seeing_halo import SeeingHalo

CATALOGUE = {effect.name: effect for effect in (TipTiltJitter, Vibration, SeeingHalo)}

__all__ = [
    "CATALOGUE",
    "Conditions",
    "Effect",
    "EffectSet",
    "Parameter",
    "Pinned",
    "SeeingHalo",
    "TipTiltJitter",
    "Vibration",
    "expected",
    "fixed_optics",
]
