"""The effects that a scene can contain: one file per plane of the light path."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

from irlos_pipe.simulate import SceneError, require_known
from irlos_pipe.simulate.effects import detector, light, pupil, sky, wavefront
from irlos_pipe.simulate.effects.base import SimulatedEffect

# By name, in the order in which effects of one plane act.
EFFECTS: dict[str, type[SimulatedEffect]] = {
    effect.name: effect
    for plane in (sky, light, pupil, wavefront, detector)
    for effect in vars(plane).values()
    if isinstance(effect, type) and issubclass(effect, SimulatedEffect) and hasattr(effect, "name")
}


def effects_of(effects: Mapping[str, Mapping[str, Any]]) -> list[SimulatedEffect]:
    """Return the effects that a mapping from names to parameters describes, in the order in which they act.

    Raises `SceneError` for unknown effects, unknown parameters and missing ones, with the nearest known name.
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
