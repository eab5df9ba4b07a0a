"""The checks of a recipe, one function per part; each notes what is wrong and returns what is right."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.overrides import absolute
from irlos_pipe.files.shipped import SAMPLES, shipped_folder
from irlos_pipe.files.validation import ValidationErrors
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import StageConfig, needs

INPUT_NAME = re.compile(r"[^\W_][\w.+-]*")  # becomes a group in products
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
    instrument: str = Field("irlos", description="instrument profile: a name, or the path of a YAML file")
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


def check_head(data: Mapping[str, Any], errors: ValidationErrors) -> RecipeHead:
    """Check the keys of `data` at the top level; wrong ones are noted in `errors` and replaced.

    So the rest can be checked too.
    """
    known = (*RecipeHead.model_fields, *SECTIONS)
    for key in data:
        if key not in known:
            errors.add((key,), f"unknown key '{key}'{suggestion(key, known)}")
    own = {key: value for key, value in data.items() if key in RecipeHead.model_fields}
    try:
        return RecipeHead.model_validate(own)
    except ValidationError as error:
        errors.add_invalid(error, RecipeHead)
        wrong = {problem["loc"][0] for problem in error.errors()}
    substitutes = {"recipe": "unnamed", "stages": list(STAGES)[:1]}
    return RecipeHead.model_validate(substitutes | {key: own[key] for key in own.keys() - wrong})


def check_section(
    data: Mapping[str, Any], name: str, model: type[Section], errors: ValidationErrors
) -> Section | None:
    """Check the section `name` of `data` against `model`, noting `errors`; absent, it takes all defaults."""
    content = {} if data.get(name) is None else data[name]
    return _validated(content, model, (name,), errors)


def check_stage_sections(data: Mapping[str, Any], errors: ValidationErrors) -> dict[str, StageConfig | None]:
    """Check the section of every stage that `data` lists or configures, noting `errors`."""
    stages = data.get("stages")
    listed = stages if isinstance(stages, list) else []
    concerned = [name for name in STAGES if name in data or name in listed]
    for name in concerned:
        if name not in listed:
            errors.add((name,), f"section '{name}' has no effect: no such stage under 'stages'")
    return {name: check_section(data, name, STAGES[name].Config, errors) for name in concerned}


def check_stages(stages: Sequence[str], errors: ValidationErrors) -> None:
    """Check names and order of the `stages`, noting `errors`."""
    for index, name in enumerate(stages):
        problem = _stage_problem(name, stages[:index])
        if problem:
            errors.add(("stages", index), problem)


def with_samples(head: RecipeHead, errors: ValidationErrors) -> dict[str, list[str]]:
    """Return the inputs of a recipe's `head` with samples for those not given, noting `errors`."""
    for name in head.samples.keys() - head.inputs.keys():
        errors.add(("samples", name), f"unknown input '{name}'{suggestion(name, head.inputs)}")
    samples = {name: [str(shipped_folder(SAMPLES) / sample)] for name, sample in head.samples.items()}
    return {name: paths or samples.get(name, []) for name, paths in head.inputs.items()}


def check_inputs(
    inputs: Mapping[str, Sequence[str]],
    folder: Path,
    errors: ValidationErrors,
    samples: Collection[str] = (),
    complete: bool = True,
) -> dict[str, tuple[Path, ...]]:
    """Check the inputs of a recipe.

    Parameters
    ----------
    inputs : mapping of str to sequence of str
        Paths by input name, counted from `folder`.
    errors : ValidationErrors
        Notes what is wrong.
    samples : collection of str
        Names of inputs that the package has a sample of.
    complete : bool
        Whether an input that is not given is wrong.

    Returns
    -------
    dict of str to tuple of Path
        Absolute paths.
    """
    for name, paths in inputs.items():
        if not INPUT_NAME.fullmatch(name):
            errors.add(
                ("inputs", name),
                f"input {name!r}: a name is made of letters, digits and . _ + - "
                "and begins with a letter or digit",
            )
        if not paths and complete:
            hint = ", or --samples for the simulated sample" if name in samples else ""
            errors.add(("inputs", name), f"input '{name}' is not given; add --input {name}=PATH{hint}")
    found = {name: tuple(absolute(path, folder) for path in paths) for name, paths in inputs.items()}
    for name, absolute_paths in found.items():
        for path in absolute_paths:
            if not str(path).isprintable():  # control characters, and bytes that are no UTF-8
                errors.add(
                    ("inputs", name),
                    f"input '{name}': {str(path)!r} holds characters that cannot be shown; rename it",
                )
            elif not os.path.exists(path):  # also of a name that no file can have
                errors.add(
                    ("inputs", name),
                    f"input '{name}': no such file or folder: {path}; "
                    f"correct it, or give --input {name}=PATH",
                )
    return found


def _validated(content: Any, model: type[Section], key: tuple, errors: ValidationErrors) -> Section | None:
    if not isinstance(content, dict):
        errors.add(key, f"{key[0]} = {content!r}: should be a section of 'key: value' lines")
        return None
    return errors.validated(content, model, key)


def _stage_problem(name: str, earlier: Sequence[str]) -> str:
    order = list(STAGES)
    if name not in order:
        return f"unknown stage '{name}'{suggestion(name, order)}"
    if name in earlier:
        return f"stage '{name}' is listed twice"
    late = [other for other in earlier if other in order[order.index(name) :]]
    if late:
        return f"stage '{name}' must come before '{late[0]}'; the order is {', '.join(order)}"
    lacking = [needed for needed in needs(STAGES[name]) if needed not in earlier]
    return f"stage '{name}' needs '{lacking[0]}' before it" if lacking else ""
