"""The effects that recipes, models and results can name."""

from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.colour import AtmosphericDispersion, PlateScale, Spectrum
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.drift import NcpaDrift
from irlos_pipe.effects.focus_stage import FocusStageHysteresis, FocusStageOffset, FocusStageScale
from irlos_pipe.effects.low_wind import LowWindEffect
from irlos_pipe.effects.motion import TipTiltJitter, Vibration
from irlos_pipe.effects.pixels import BackgroundGradient, BadPixels, DetectorNonlinearity, InterpixelCrosstalk
from irlos_pipe.effects.pupil_stop import AmplitudeAberration, PupilMisregistration
from irlos_pipe.effects.seeing_halo import SeeingHalo
from irlos_pipe.effects.wavefront import DiversityError, HighOrderNcpa, PhaseBump

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
        FocusStageOffset,
        FocusStageScale,
        FocusStageHysteresis,
    )
}
