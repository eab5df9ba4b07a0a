"""Physical effects beyond the static wavefront, each declaring where on the light path it acts."""

from .base import Conditions, OtfEffect, OtfGrid, Parameter
from .pinned import Pinned, expected
from .seeing_halo import SeeingHalo
from .tip_tilt_jitter import TipTiltJitter
from .transfer import Transfer, fixed_transfer

CATALOGUE = {effect.name: effect for effect in (SeeingHalo, TipTiltJitter)}

__all__ = [
    "CATALOGUE",
    "Conditions",
    "OtfEffect",
    "OtfGrid",
    "Parameter",
    "Pinned",
    "SeeingHalo",
    "TipTiltJitter",
    "Transfer",
    "expected",
    "fixed_transfer",
]
