"""A simulation spec: what is recorded under which conditions, checked before anything is computed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.overrides import Override, absolute, parse_setting, read_overridden
from irlos_pipe.files.shipped import SIMULATIONS, named_file
from irlos_pipe.files.validation import ValidationErrors
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.instrument.instrument import Instrument, checked_instrument, located
from irlos_pipe.simulate.recordings.planned import DOUBLE
from irlos_pipe.simulate.recordings.recording_keys import RecordingKeys, Shared
from irlos_pipe.simulate.recordings.scenes import base_scene
from irlos_pipe.simulate.scene import Scene

SETTING_EXAMPLE = "KEY=VALUE, for example recordings.calibration.frames=20"
WHOLE = {"ncpa", "rotating"}  # half of a draw and half of a list make no sense
NAME = r"^[A-Za-z0-9][A-Za-z0-9._+:-]*$"  # becomes the name of a folder


class SpecKeys(Shared):
    """The whole file."""

    simulation: str = Field(min_length=1, description="name of the simulation")
    title: str = Field("", description="one line for people")
    instrument: str = Field("irlos", description="instrument profile: a name, or the path of a YAML file")
    seed: int = Field(0, ge=0, lt=2**63, description="seed of everything random")
    recordings: dict[str, RecordingKeys] = Field(min_length=1, description="name: section of each recording")


@dataclass(frozen=True)
class Spec:
    """A valid spec.

    Attributes
    ----------
    instrument_name : str
        Name of the profile, or the absolute path of its file.
    recordings : dict of str to RecordingKeys
        By name, the shared sections filled in.
    scenes : dict of str to Scene
        What all recordings of such a section have in common.
    """

    name: str
    title: str
    seed: int
    instrument_name: str
    instrument: Instrument
    recordings: dict[str, RecordingKeys]
    scenes: dict[str, Scene]

    def resolved_yaml(self) -> str:
        """Return the spec with every default explicit; it makes the same recordings again."""
        head = {
            "simulation": self.name,
            "title": self.title,
            "instrument": self.instrument_name,
            "seed": self.seed,
        }
        recordings = {
            name: keys.model_dump(mode="json", exclude_none=True, by_alias=True)
            for name, keys in self.recordings.items()
        }
        return yaml_text(head | {"recordings": recordings})


def load_spec(path: str | Path, settings: Iterable[str] = (), seed: int | None = None) -> Spec:
    """Read and check a spec.

    Parameters
    ----------
    path : str or Path
        The specification: a file, or the name of one that comes with the package, such as ``on_sky``.
    settings : iterable of str
        ``key.key=VALUE``, applied in order; the value is YAML. The path of ``instrument=PATH`` counts from
        the current folder.
    seed : int, optional
        Replaces the spec's seed.

    Raises
    ------
    ConfigurationError
        With one line ``where: message`` for everything that is wrong.
    """
    path = named_file(path, SIMULATIONS)
    return _checked(path, *read_overridden(path, _parse_setting, settings, seed=seed))


def _parse_setting(text: str) -> Override:
    return located(parse_setting(text, SETTING_EXAMPLE))


def _checked(path: Path, data: Mapping[str, Any], errors: ValidationErrors) -> Spec:
    keys = errors.validated(data, SpecKeys)
    errors.raise_if_any()
    assert keys is not None, "what is wrong has been reported"
    for name in keys.recordings:
        _check_name(name, errors)
    instrument_name, instrument = checked_instrument(keys.instrument, absolute(path).parent, errors)
    recordings, scenes = {}, {}
    for name, own in data["recordings"].items():
        merged = errors.validated(_with_shared(own, data), RecordingKeys, ("recordings", name))
        if merged is None or instrument is None:
            continue
        recordings[name] = merged.completed(instrument.facility)
        try:
            scenes[name] = base_scene(instrument, keys.seed, name, recordings[name])
        except ConfigurationError as problem:
            errors.add(("recordings", name), f"recordings.{name}: {problem}")
    errors.raise_if_any()
    assert instrument is not None, "what is wrong has been reported"
    return Spec(keys.simulation, keys.title, keys.seed, instrument_name, instrument, recordings, scenes)


def _with_shared(own: Mapping[str, Any], shared: Mapping[str, Any]) -> dict[str, Any]:
    """A recording's `own` sections over the `shared` ones, key by key; null switches a shared one off."""
    merged = {name: shared[name] for name in Shared.model_fields if name in shared} | dict(own)
    for name in merged.keys() & shared.keys() - WHOLE:
        if None not in (merged[name], shared[name]):
            merged[name] = {**shared[name], **merged[name]}
    return merged


def _check_name(name: str, errors: ValidationErrors) -> None:
    if not re.match(NAME, name) or DOUBLE in name:
        errors.add(
            ("recordings", name),
            f"recordings.{name}: becomes the name of a folder; use letters, digits and . _ + : - "
            f"(no '{DOUBLE}'), beginning with a letter or digit",
        )
