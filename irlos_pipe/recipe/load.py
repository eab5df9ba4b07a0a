"""A recipe: which stages run on which inputs with which settings, checked before anything runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from irlos_pipe.files.overrides import Override, absolute, parse_setting, read_overridden
from irlos_pipe.files.validation import ValidationErrors
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.instrument.instrument import Instrument, checked_instrument
from irlos_pipe.recipe.checks import (
    SECTIONS,
    check_head,
    check_inputs,
    check_section,
    check_stage_sections,
    check_stages,
)
from irlos_pipe.stages.base import StageConfig
from irlos_pipe.stages.model.section import ModelConfig


@dataclass(frozen=True)
class Recipe:
    """A valid recipe with every default filled in.

    Attributes
    ----------
    instrument_name : str
        Name of the profile, or the absolute path of its file.
    inputs : dict of str to tuple of Path
        Absolute paths by input name.
    stages : tuple of str
        Stage names in running order.
    configs : dict of str to StageConfig
        One configuration per stage of `stages`.
    """

    path: Path
    name: str
    title: str
    instrument_name: str
    instrument: Instrument
    inputs: dict[str, tuple[Path, ...]]
    stages: tuple[str, ...]
    model: ModelConfig
    configs: dict[str, StageConfig]
    seed: int

    def resolved_yaml(self) -> str:
        """Return the recipe with every default explicit and absolute paths; it can be run again."""
        head = {
            "recipe": self.name,
            "title": self.title,
            "instrument": self.instrument_name,
            "inputs": {name: [str(path) for path in paths] for name, paths in self.inputs.items()},
            "stages": list(self.stages),
            "seed": self.seed,
            "model": self.model.model_dump(mode="json"),
        }
        sections = {name: config.model_dump(mode="json") for name, config in self.configs.items()}
        return yaml.safe_dump(head | sections, sort_keys=False, allow_unicode=True, width=110)


def load_recipe(
    path: str | Path, settings: Iterable[str] = (), inputs: Iterable[str] = (), seed: int | None = None
) -> Recipe:
    """Read and check a recipe.

    Parameters
    ----------
    path : str or Path
        The recipe.
    settings : iterable of str
        ``stage.key=VALUE``, applied in order; the value is YAML. ``section=PATH`` takes a whole section from
        a file, as ``model=DIR/model.yaml``; the path counts from the current folder.
    inputs : iterable of str
        ``NAME=PATH``, relative to the current folder; a name given again makes a list.
    seed : int, optional
        Replaces the recipe's seed.

    Raises
    ------
    ConfigurationError
        With one line ``where: message`` for everything that is wrong.
    """
    path = Path(path)
    return _checked(path, *read_overridden(path, _parse_setting, settings, inputs, seed))


def _parse_setting(text: str) -> Override:
    """A setting; a section given by name is read."""
    override = parse_setting(text)
    whole = len(override.key) == 1 and override.key[0] in SECTIONS
    if not whole or not isinstance(override.value, str):
        return override
    return replace(override, value=load_yaml(absolute(override.value))[0])


def _checked(path: Path, data: dict[str, Any], errors: ValidationErrors) -> Recipe:
    head = check_head(data, errors)
    model = check_section(data, "model", ModelConfig, errors)
    configs = check_stage_sections(data, errors)
    check_stages(head.stages, errors)
    inputs = check_inputs(head.inputs, absolute(path).parent, errors)
    instrument_name, instrument = checked_instrument(head.instrument, absolute(path).parent, errors)
    errors.raise_if_any()
    assert model is not None and instrument is not None, "what is missing has been reported"
    return Recipe(
        absolute(path),
        head.recipe,
        head.title,
        instrument_name,
        instrument,
        inputs,
        tuple(head.stages),
        model.completed(instrument.facility),
        {name: config for name in head.stages if (config := configs[name]) is not None},
        head.seed,
    )
