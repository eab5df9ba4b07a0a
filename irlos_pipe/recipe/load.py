"""A recipe: which stages run on which inputs with which settings, checked before anything runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from irlos_pipe.files.overrides import Override, absolute, parse_setting, read_overridden
from irlos_pipe.files.shipped import RECIPES, are_samples, named_file
from irlos_pipe.files.validation import ValidationErrors
from irlos_pipe.files.yaml import load_yaml, yaml_text
from irlos_pipe.instrument.instrument import Instrument, checked_instrument, located
from irlos_pipe.recipe.checks import (
    SECTIONS,
    check_head,
    check_inputs,
    check_section,
    check_stage_sections,
    check_stages,
    with_samples,
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
    samples : tuple of str
        Names of the inputs that are sample recordings of the package.
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
    samples: tuple[str, ...]
    stages: tuple[str, ...]
    model: ModelConfig
    configs: dict[str, StageConfig]
    seed: int

    @property
    def notice(self) -> str:
        """What has to be said before any result: that it is one of sample recordings; else empty."""
        names = " and ".join(map(repr, self.samples))
        return names and f"simulated sample: {names} came with the package; no instrument was measured"

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
        return yaml_text(head | sections)


def load_recipe(
    path: str | Path,
    settings: Iterable[str] = (),
    inputs: Iterable[str] = (),
    seed: int | None = None,
    *,
    samples: bool = False,
    complete: bool = True,
) -> Recipe:
    """Read and check a recipe.

    Parameters
    ----------
    path : str or Path
        The recipe: a file, or the name of one that comes with the package, such as ``ncpa_calibration``.
    settings : iterable of str
        ``stage.key=VALUE``, applied in order; the value is YAML. ``section=PATH`` takes a whole section from
        a file, as ``model=DIR/model.yaml``; this path, and that of ``instrument=PATH``, count from the
        current folder.
    inputs : iterable of str
        ``NAME=PATH``, relative to the current folder; a name given again makes a list.
    seed : int, optional
        Replaces the recipe's seed.
    samples : bool
        Take sample recordings of the package for the inputs that are not given.
    complete : bool
        Whether an input that is not given is an error. A recipe without it can be looked at, but not run.

    Raises
    ------
    ConfigurationError
        With one line ``where: message`` for everything that is wrong.
    """
    path = named_file(path, RECIPES)
    read = read_overridden(path, _parse_setting, settings, inputs, seed)
    return _checked(path, *read, samples=samples, complete=complete)


def _parse_setting(text: str) -> Override:
    """A setting; a section given by the path of its file is read."""
    override = located(parse_setting(text))
    whole = len(override.key) == 1 and override.key[0] in SECTIONS
    if not whole or not isinstance(override.value, str):
        return override
    return replace(override, value=load_yaml(absolute(override.value))[0])


def _checked(
    path: Path, data: dict[str, Any], errors: ValidationErrors, *, samples: bool, complete: bool
) -> Recipe:
    head = check_head(data, errors)
    model = check_section(data, "model", ModelConfig, errors)
    configs = check_stage_sections(data, errors)
    check_stages(head.stages, errors)
    given = with_samples(head, errors) if samples else head.inputs
    inputs = check_inputs(given, absolute(path).parent, errors, head.samples, complete)
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
        tuple(name for name, paths in inputs.items() if are_samples(paths)),
        tuple(head.stages),
        model.completed(instrument.facility),
        {name: config for name in head.stages if (config := configs[name]) is not None},
        head.seed,
    )
