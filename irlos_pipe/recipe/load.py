"""A recipe: which stages run on which inputs with which settings, checked before anything runs."""

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from irlos_pipe.conventions.text import nearest, suggestion
from irlos_pipe.files.shipped import RECIPES, SAMPLES, are_samples, named_file, shipped_folder
from irlos_pipe.files.validation import Override, ValidationErrors, absolute, parse_setting, read_overridden
from irlos_pipe.files.yaml import load_yaml, yaml_text
from irlos_pipe.instrument.instrument import Instrument, checked_instrument, located
from irlos_pipe.readers.sidecar import stated_instrument, stated_instruments
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import ModelConfig, StageConfig, declared_by

INPUT_NAME = re.compile(r"[^\W_][\w.+-]*")  # becomes a group in products
Needed = Literal["all", "given", "none"]
Section = TypeVar("Section", bound=BaseModel)


def _as_list(value: Any) -> Any:
    if value is None:
        return []
    return value if isinstance(value, list) else [value]


def _none_as_empty(value: Any) -> Any:
    return {} if value is None else value


class RecipeHead(BaseModel):
    """The keys of a recipe that are not sections of a stage."""

    model_config = ConfigDict(defer_build=True, extra="forbid")

    recipe: str = Field(min_length=1, description="name of the recipe")
    title: str = Field("", description="one line for people")
    instrument: str = Field(
        "irlos",
        description="instrument profile: a name or the path of a YAML file; without it that of the side-cars",
    )
    inputs: Annotated[
        dict[str, Annotated[list[str], BeforeValidator(_as_list)]], BeforeValidator(_none_as_empty)
    ] = Field(
        {},
        description="input name: a path or a list of paths, relative to the recipe, or nothing for one "
        "that is given with --input; none where the stages make their own data",
    )
    samples: Annotated[dict[str, str], BeforeValidator(_none_as_empty)] = Field(
        {}, description="input name: the recording of data_samples that --samples takes for it"
    )
    stages: list[str] = Field(min_length=1, description="stages in the order of the light path")
    seed: int = Field(0, ge=0, description="seed of every random draw")


SECTIONS = ("model", *STAGES)


@dataclass(frozen=True)
class Recipe:
    """A valid recipe with every default filled in."""

    path: Path
    name: str
    title: str
    instrument_name: str  # of the profile, or the absolute path of its file
    instrument: Instrument
    instrument_by: str  # where it is stated; empty where nobody states it
    inputs: dict[str, tuple[Path, ...]]  # absolute paths by input name
    samples: tuple[str, ...]  # names of the inputs that are sample recordings of the package
    stages: tuple[str, ...]  # names in running order
    model: ModelConfig
    configs: dict[str, StageConfig]  # by stage
    seed: int

    @property
    def instrument_text(self) -> str:
        """The instrument profile that was taken, and who states it."""
        by = self.instrument_by or "nobody states another; key 'instrument' of a side-car does"
        return f"{self.instrument.name} ({by})"

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
    settings: Iterable[str] | Mapping[str, Any] = (),
    inputs: Iterable[str] = (),
    seed: int | None = None,
    *,
    samples: bool = False,
    needed: Needed = "all",
) -> Recipe:
    """Read and check a recipe.

    Parameters
    ----------
    path : str or Path
        The recipe: a file, or the name of one that comes with the package, such as ``ncpa_calibration``.
    settings : iterable of str, or mapping
        ``stage.key=VALUE``, applied in order; the value is YAML, in a mapping a Python value.
        ``section=PATH`` takes a whole section from a file, as ``model=DIR/model.yaml``; this path, and that
        of ``instrument=PATH``, count from the current folder.
    inputs : iterable of str
        ``NAME=PATH``, relative to the current folder; a name given again makes a list.
    seed : int, optional
        Replaces the recipe's seed.
    samples : bool
        Take sample recordings of the package for the inputs that are not given.
    needed : {"all", "given", "none"}
        Inputs that are an error unless they are there. With those `given` a recipe can be looked at, but not
        run; with none, the products of a run can be read whose recordings have moved.

    Raises
    ------
    ConfigurationError
        With one line ``where: message`` for everything that is wrong.
    InputDataError
        Side-cars state different instruments, or one that cannot be used, and the recipe states none.
    """
    path = named_file(path, RECIPES)
    given: Iterable[Any] = settings.items() if isinstance(settings, Mapping) else settings
    data, errors = read_overridden(path, _parse_setting, given, inputs, seed)
    head = _check_head(data, errors)
    model = _check_section(data, "model", ModelConfig, errors)
    stages = data.get("stages")
    listed = stages if isinstance(stages, list) else []
    concerned = [name for name in STAGES if name in data or name in listed]
    for name in concerned:
        if name not in listed:
            errors.add((name,), f"section '{name}' has no effect: no such stage under 'stages'")
    configs = {name: _check_section(data, name, STAGES[name].Config, errors) for name in concerned}
    for index, name in enumerate(head.stages):
        problem = _stage_problem(name, head.stages[:index])
        if problem:
            errors.add(("stages", index), problem)
        taken = getattr(configs.get(name), "input", None)
        if head.inputs and taken is not None and taken not in head.inputs:
            errors.add((name, "input"), f"unknown input '{taken}'{suggestion(taken, head.inputs)}")
    named = "instrument" in head.model_fields_set
    sources = _with_samples(head, errors) if samples else head.inputs
    paths = _check_inputs(sources, absolute(path).parent, errors, head.samples, needed)
    instrument_name, instrument = checked_instrument(head.instrument, absolute(path).parent, errors)
    errors.raise_if_any()
    by = errors.origins.where(("instrument",)).removeprefix(f"{path.parent}/") if named else ""
    stated = stated_instruments(chain.from_iterable(paths.values()))
    if stated and not named:
        instrument_name, instrument, by = stated_instrument(stated)
    others = [one for one in stated if one != instrument_name]
    by += "".join(f"; not {other} as side-car {stated[other].name} states" for other in others)
    assert model is not None and instrument is not None, "what is missing has been reported"
    return Recipe(
        absolute(path),
        head.recipe,
        head.title,
        instrument_name,
        instrument,
        by,
        paths,
        tuple(name for name, own in paths.items() if are_samples(own)),
        tuple(head.stages),
        model.completed(instrument.facility),
        {name: config for name in head.stages if (config := configs[name]) is not None},
        head.seed,
    )


def _parse_setting(given: str | tuple[str, Any]) -> Override:
    """A setting, as text or as key and value; a section given by the path of its file is read."""
    if isinstance(given, str):
        override = located(parse_setting(given))
    else:  # the key as in text, which has no value yet
        override = located(replace(parse_setting(f"{given[0]}="), value=given[1]))
    whole = len(override.key) == 1 and override.key[0] in SECTIONS
    if not whole or not isinstance(override.value, str):
        return override
    return replace(override, value=load_yaml(absolute(override.value))[0])


# -- checks, one function a part: each notes what is wrong and returns what is right ------------


def _check_head(data: Mapping[str, Any], errors: ValidationErrors) -> RecipeHead:
    """Check the keys of `data` at the top level; wrong ones are noted in `errors` and replaced.

    So the rest can be checked too.
    """
    known = (*RecipeHead.model_fields, *SECTIONS)
    for key in data:
        if key not in known:
            errors.add((key,), f"unknown key '{key}'{_suggested(key, known, data.get('stages'))}")
    own = {key: value for key, value in data.items() if key in RecipeHead.model_fields}
    try:
        return RecipeHead.model_validate(own)
    except ValidationError as error:
        errors.add_invalid(error, RecipeHead)
        wrong = {problem["loc"][0] for problem in error.errors()}
    substitutes = {"recipe": "unnamed", "stages": list(STAGES)[:1]}
    return RecipeHead.model_validate(substitutes | {key: own[key] for key in own.keys() - wrong})


def _suggested(key: str, known: Sequence[str], stages: Any) -> str:
    """Suggest a key that is `known`, or one of a section of the recipe, which was given without it."""
    listed = [one for one in STAGES if isinstance(stages, list) and one in stages]
    sections = {"model": ModelConfig} | {one: STAGES[one].Config for one in listed}
    pairs = [(inner, f"{name}.{inner}") for name, one in sections.items() for inner in one.model_fields]
    whole = dict(reversed(pairs))  # of several stages the first
    close = key if key in whole else nearest(key, [*known, *whole])
    return suggestion(key, known) if close in known or close is None else f"; did you mean '{whole[close]}'?"


def _check_section(
    data: Mapping[str, Any], name: str, model: type[Section], errors: ValidationErrors
) -> Section | None:
    """Check the section `name` of `data` against `model`, noting `errors`; absent, it takes all defaults."""
    content = {} if data.get(name) is None else data[name]
    if not isinstance(content, dict):
        errors.add((name,), f"{name} = {content!r}: should be a section of 'key: value' lines")
        return None
    return errors.validated(content, model, (name,))


def _with_samples(head: RecipeHead, errors: ValidationErrors) -> dict[str, list[str]]:
    """Return the inputs of a recipe's `head` with samples for those not given, noting `errors`."""
    for name in head.samples.keys() - head.inputs.keys():
        errors.add(("samples", name), f"unknown input '{name}'{suggestion(name, head.inputs)}")
    samples = {name: [str(shipped_folder(SAMPLES) / sample)] for name, sample in head.samples.items()}
    return {name: paths or samples.get(name, []) for name, paths in head.inputs.items()}


def _check_inputs(
    inputs: Mapping[str, Sequence[str]],
    folder: Path,
    errors: ValidationErrors,
    samples: Collection[str] = (),
    needed: Needed = "all",
) -> dict[str, tuple[Path, ...]]:
    """Return absolute paths of `inputs`, which count from `folder`, noting `errors`.

    For those that are `needed` see `load_recipe`; the package has `samples` for some.
    """

    def wrong(name: str, message: str) -> None:
        errors.add(("inputs", name), message)

    for name, paths in inputs.items():
        if not INPUT_NAME.fullmatch(name):
            allowed = "letters, digits and . _ + - and begins with a letter or digit"
            wrong(name, f"input {name!r}: a name is made of {allowed}")
        if not paths and needed == "all":
            hint = ", or --samples for the simulated sample" if name in samples else ""
            wrong(name, f"input '{name}' is not given; add --input {name}=PATH{hint}")
    found = {name: tuple(absolute(path, folder) for path in paths) for name, paths in inputs.items()}
    for name, absolute_paths in found.items():
        for path in absolute_paths:
            if not str(path).isprintable():  # control characters, and bytes that are no UTF-8
                wrong(name, f"input '{name}': {str(path)!r} holds characters that cannot be shown; rename it")
            elif needed != "none" and not os.path.exists(path):  # also of a name that no file can have
                hint = f"correct it, or give --input {name}=PATH"
                wrong(name, f"input '{name}': no such file or folder: {path}; {hint}")
    return found


def _stage_problem(name: str, earlier: Sequence[str]) -> str:
    """What is wrong with the name of a stage, or its place behind the `earlier` ones; empty if nothing is."""
    order = list(STAGES)
    if name not in order:
        return f"unknown stage '{name}'{suggestion(name, order)}"
    if name in earlier:
        return f"stage '{name}' is listed twice"
    late = [other for other in earlier if other in order[order.index(name) :]]
    if late:
        return f"stage '{name}' must come before '{late[0]}'; the order is {', '.join(order)}"
    lacking = [needed for needed in declared_by(STAGES[name], "NEEDS") if needed not in earlier]
    return f"stage '{name}' needs '{lacking[0]}' before it" if lacking else ""
