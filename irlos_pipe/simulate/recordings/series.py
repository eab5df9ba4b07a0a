"""The recordings of a spec: names, times, and what the observer knows of each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from irlos_pipe.simulate.effects import effects_of
from irlos_pipe.simulate.effects.wavefront import reached_nm
from irlos_pipe.simulate.recordings.files import LOOP_HZ, Defocus, Planned
from irlos_pipe.simulate.recordings.keys import RecordingKeys
from irlos_pipe.simulate.recordings.spec import Spec, number

FIRST_START_UNIX_S = 1_707_618_000
SLOT_S = 86_400  # between the starts of two sections of a spec, so that a change of one moves no other
MOVE_S = 24  # time that focus stage or derotator take between the recordings of a series
FIRST_COUNTER, COUNTER_WRAP = 1000, 2**30


class _Member(NamedTuple):
    """One recording of a series; `position` is its place in time."""

    name: str
    position: int
    commanded_nm: Defocus
    reached_nm: Defocus
    angle_deg: float


def plan_recordings(spec: Spec) -> list[Planned]:
    """Return the recordings of a `spec`, those of a series in the order of their list."""
    sections = enumerate(spec.recordings.items())
    return [planned for slot, (name, keys) in sections for planned in _section(spec, slot, name, keys)]


def _section(spec: Spec, slot: int, name: str, keys: RecordingKeys) -> Iterator[Planned]:
    """Recordings of one section of the spec, which starts as declared or by its place (`slot`) there."""
    scene, hidden = spec.scenes[name], keys.hidden
    rng = np.random.default_rng([spec.seed, number(name), number("focus stage")])
    duration_s = MOVE_S + int(np.ceil(scene.frames * scene.period_s))
    first_s = FIRST_START_UNIX_S + slot * SLOT_S
    if keys.start is not None:
        first_s = int(np.datetime64(keys.start, "s").astype(int))
    for member in _members(name, keys, hidden, rng):
        after_s = member.position * duration_s
        own = replace(
            scene,
            name=member.name,
            seed=(spec.seed, number(member.name)),
            introduced_nm=member.reached_nm,
            derotator_angle_deg=member.angle_deg,
            start_unix_s=first_s + after_s,
            first_counter=FIRST_COUNTER + after_s * LOOP_HZ % COUNTER_WRAP,
        )
        yield Planned(member.name, own, member.commanded_nm, hidden, keys.layout, keys.mode, keys.side_car)


def _members(name: str, keys: RecordingKeys, hidden: Mapping, rng: np.random.Generator) -> list[_Member]:
    if keys.offsets_nm:
        return _ramp(name, keys, keys.offsets_nm, hidden, rng)
    commanded_nm: Defocus
    true_nm: Defocus
    reached = reached_nm(np.broadcast_to(keys.introduced_nm, (keys.frames,)), effects_of(hidden), rng)
    if isinstance(keys.introduced_nm, list):
        commanded_nm, true_nm = tuple(keys.introduced_nm), tuple(reached.tolist())
    else:
        commanded_nm, true_nm = keys.introduced_nm, float(reached[0])
    if not keys.angles_deg:
        return [_Member(name, 0, commanded_nm, true_nm, keys.derotator_angle_deg)]
    turns = zip(numbered(name, "angle", keys.angles_deg), keys.angles_deg, strict=True)
    return [_Member(own, index, commanded_nm, true_nm, angle) for index, (own, angle) in enumerate(turns)]


def _ramp(
    name: str, keys: RecordingKeys, offsets_nm: Sequence[float], hidden: Mapping, rng: np.random.Generator
) -> list[_Member]:
    """One recording per focus offset."""
    order = visiting_order(offsets_nm, keys.order)
    reached = reached_nm([offsets_nm[index] for index in order], effects_of(hidden), rng).tolist()
    places = [order.index(index) for index in range(len(order))]
    return [
        _Member(own, place, commanded_nm, reached[place], keys.derotator_angle_deg)
        for own, place, commanded_nm in zip(
            numbered(name, "offset", offsets_nm), places, offsets_nm, strict=True
        )
    ]


def numbered(name: str, what: str, values: Sequence[float]) -> list[str]:
    """Return ``<name>/<what>_<index>`` for each of `values`: the recordings of series `name`, by `what`."""
    digits = max(2, len(str(len(values) - 1)))
    return [f"{name}/{what}_{index:0{digits}d}" for index in range(len(values))]


def visiting_order(offsets_nm: Sequence[float], order: str) -> list[int]:
    """Return the indices of `offsets_nm` in the `order` of recording.

    ``ping_pong`` goes from the ends inwards and changes side after every offset, so that
    successive offsets are reached from opposite directions; ``as_given`` keeps the list.
    """
    if order == "as_given":
        return list(range(len(offsets_nm)))
    ascending = np.argsort(offsets_nm, kind="stable").tolist()
    inwards = [index for pair in zip(ascending, reversed(ascending), strict=True) for index in pair]
    return inwards[: len(ascending)]
