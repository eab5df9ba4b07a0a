"""Physical effects beyond the static wavefront, each declaring where on the light path it acts."""

from .base import Conditions, Effect, Parameter
from .colour import AtmosphericDispersion, PlateScale, Spectrum
from .companion import Companion
from .drift import NcpaDrift
from .effect_set import EffectSet, fixed_optics
from .focus_stage import FocusStageHysteresis, FocusStageOffset, FocusStageScale
from .low_wind import LowWindEffect
from .motion import TipTiltJitter, Vibration
from .pinned import Pinned, expected
from .pixels import BackgroundGradient, BadPixels, DetectorNonlinearity, InterpixelCrosstalk
from .pupil_stop import AmplitudeAberration, PupilMisregistration
from .seeing_halo import SeeingHalo
from .wavefront import DiversityError, HighOrderNcpa, PhaseBump

CATALOGUE: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        TipTiltJitter,
        Vibration,
        SeeingHalo,
        AtmosphericDispersion,
        Spectrum,
        PlateScale,
        DiversityError,
        PupilMisregistration,
        AmplitudeAberration,
        LowWindEffect,
        HighOrderNcpa,
        PhaseBump,
        NcpaDrift,
        Companion,
        InterpixelCrosstalk,
        DetectorNonlinearity,
        BackgroundGradient,
        BadPixels,
        FocusStageHysteresis,
        FocusStageOffset,
        FocusStageScale,
    )
}

__all__ = [
    "CATALOGUE",
    "Conditions",
    "Effect",
    "EffectSet",
    "Parameter",
    "Pinned",
    "SeeingHalo",
    "TipTiltJitter",
    "expected",
    "fixed_optics",
]
