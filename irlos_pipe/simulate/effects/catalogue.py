"""The effects that a scene can contain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

from irlos_pipe.simulate.effects.base import SimulatedEffect
from irlos_pipe.simulate.effects.colour import Anamorphism, AtmosphericDispersion, PlateScale, Spectrum
from irlos_pipe.simulate.effects.companion import Companion
from irlos_pipe.simulate.effects.detector import (
    BackgroundGradient,
    BadPixels,
    CorrelatedNoise,
    DetectorNonlinearity,
    InterpixelCrosstalk,
)
from irlos_pipe.simulate.effects.focus_stage import FocusStageHysteresis, FocusStageOffset, FocusStageScale
from irlos_pipe.simulate.effects.ghost import Ghost
from irlos_pipe.simulate.effects.high_aperture import HighAperture
from irlos_pipe.simulate.effects.motion import TipTiltJitter, Vibration
from irlos_pipe.simulate.effects.pupil import (
    AmplitudeAberration,
    LowWindEffect,
    PupilMisregistration,
    PupilSizes,
    PupilSpot,
    SegmentPiston,
)
from irlos_pipe.simulate.effects.seeing_halo import SeeingHalo
from irlos_pipe.simulate.effects.uneven_residual import UnevenResidual
from irlos_pipe.simulate.effects.wavefront import (
    ChromaticNcpa,
    DiversityError,
    FilterNcpa,
    HighOrderNcpa,
    NcpaDrift,
    PhaseBump,
)
from irlos_pipe.simulate.errors import SceneError, require_known

# By name, in the order in which effects of one plane act.
EFFECTS: dict[str, type[SimulatedEffect]] = {
    effect.name: effect
    for effect in (
        TipTiltJitter,
        Vibration,
        SeeingHalo,
        UnevenResidual,
        Spectrum,
        AtmosphericDispersion,
        PlateScale,
        Anamorphism,
        Companion,
        Ghost,
        PupilMisregistration,
        PupilSizes,
        AmplitudeAberration,
        PupilSpot,
        LowWindEffect,
        SegmentPiston,
        HighOrderNcpa,
        DiversityError,
        PhaseBump,
        NcpaDrift,
        ChromaticNcpa,
        FilterNcpa,
        FocusStageScale,
        FocusStageHysteresis,
        FocusStageOffset,
        HighAperture,
        InterpixelCrosstalk,
        DetectorNonlinearity,
        BackgroundGradient,
        CorrelatedNoise,
        BadPixels,
    )
}


def effects_of(effects: Mapping[str, Mapping[str, Any]]) -> list[SimulatedEffect]:
    """Return the effects that a mapping from names to parameters describes, in the order in which they act.

    Raises
    ------
    SceneError
        For unknown effects, unknown parameters and missing ones, with the nearest known name.
    """
    require_known("effects", effects, EFFECTS)
    return [_effect(kind, effects[name]) for name, kind in EFFECTS.items() if name in effects]


def _effect(kind: type[SimulatedEffect], parameters: Mapping[str, Any]) -> SimulatedEffect:
    where, known = f"effects.{kind.name}", fields(kind)
    require_known(where, parameters, [one.name for one in known])
    missing = sorted(one.name for one in known if one.default is MISSING and one.name not in parameters)
    if missing:
        raise SceneError(f"{where}: {', '.join(missing)} must be given")
    return kind(**parameters)
