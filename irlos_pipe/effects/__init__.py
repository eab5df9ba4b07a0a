"""Physical effects beyond the static wavefront, each declaring where on the light path it acts."""

from .base import OtfEffect, OtfGrid, Parameter
from .pinned import Pinned
from .seeing_halo import SeeingHalo
from .tip_tilt_jitter import TipTiltJitter
from .transfer import Transfer

EFFECTS = (SeeingHalo.name, TipTiltJitter.name)

__all__ = [
    "EFFECTS",
    "OtfEffect",
    "OtfGrid",
    "Parameter",
    "Pinned",
    "SeeingHalo",
    "TipTiltJitter",
    "Transfer",
]
