"""Results of the stages as typed objects, and results.json as a whole.

Every stage states its section of results.json as a model derived from `StageResults`: the keys with their
units are its fields. The stage returns it, the product stores it as JSON, and whoever reads a product or
results.json takes the same model, never the keys as text. NaN in memory is null in JSON. Every field has a
default, so that a product of an older version, which lacks a key, can still be read.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from math import nan
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar, get_args, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.keys import DITTO as DITTO
from irlos_pipe.conventions.keys import Number as Number
from irlos_pipe.files.json import jsonable
from irlos_pipe.files.regular import read_regular
from irlos_pipe.product.product import Product

ByNoll = dict[int, Number]  # coefficients [nm RMS] by Noll index, which is text in JSON
# Values of an effect's parameters by name, as `describe` of the effect gives them: numbers, words, or
# lists and tables of numbers.
EffectValues = dict[str, Any]

LOST = "Lost"  # begins the lines of a summary that say which exposures failed


def item(default: Any, meaning: str = "", **limits: Any) -> Any:
    """Return the field of a model of results or settings: value where it is not given, meaning, limits."""
    return Field(default, description=meaning, **limits)


class ResultsPart(BaseModel):
    """Base of everything that stands in results.json; keys of a newer version are ignored."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        defer_build=True, extra="ignore", frozen=True, populate_by_name=True
    )

    @classmethod
    def filled_from(cls, *sources: object, **own: Any) -> Self:
        """Return what the `sources`, first ones first, have of the fields, arrays as lists, and the `own`."""
        names = [name for name in cls.model_fields if name not in own]
        found = {name: getattr(one, name) for one in sources[::-1] for name in names if hasattr(one, name)}
        plain = {name: one.tolist() if isinstance(one, np.ndarray) else one for name, one in found.items()}
        return cls(**plain | own)

    @classmethod
    def rows(cls, **columns: Any) -> list[Self]:
        """Return one for each value of the `columns`, lists or arrays of one length."""
        plain = [one.tolist() if isinstance(one, np.ndarray) else one for one in columns.values()]
        return [cls(**dict(zip(columns, row, strict=True))) for row in zip(*plain, strict=True)]

    def as_json(self) -> dict[str, Any]:
        """Return the keys that were set, in the types of JSON."""
        return jsonable(self.model_dump(exclude_unset=True, by_alias=True))


class StageResults(ResultsPart):
    """Base of the section of one stage, named by `stage`."""

    stage: ClassVar[str]
    untested: list[str] = item(
        [],
        "What the data cannot tell and stands as declared: the first key of the section, before any number.",
    )


class InputFileEntry(ResultsPart):
    """A file that a run read; what its label begins with is the recipe input."""

    label: str
    sha256: str


class Machine(ResultsPart):
    """The computer that a product was made on."""

    host: str = ""
    platform: str = ""


class Provenance(ResultsPart):
    """Where a product comes from."""

    key: str = item("", "Checksum of all that the product depends on; `parts` are what it was made of.")
    parts: dict[str, Any] = {}
    recipe: str = ""
    summary: list[str] = item(
        [], "Lines for the terminal, and one line per exposure that failed, which the former end with."
    )
    failures: list[str] = item([], DITTO)
    files: list[str] = item(
        [], "Further files that the stage wrote; `file_sha256` are their checksums by name."
    )
    file_sha256: dict[str, str] = {}
    inputs: list[InputFileEntry] = []
    seed: int | None = None
    device: str = ""
    jobs: int | None = None
    software: dict[str, str] = item({}, "Versions by package.")
    machine: Machine = Machine()
    command: str = ""
    notice: str = item("", "What has to be said before any number; empty if nothing has to be.")
    started: str = item("", "UTC, ISO 8601; `seconds` lie between.")
    finished: str = item("", DITTO)
    seconds: Number = nan


Results = TypeVar("Results", bound=StageResults)
Part = TypeVar("Part", bound=ResultsPart)


class RunResults(ResultsPart):
    """Content of results.json."""

    format: str = Field("irlos-results", alias="schema")
    schema_version: int = 1
    recipe: str = ""
    status: str = item("", "``ok``, ``qc_failed``, ``partial`` or ``failed``.")
    notice: str = item(
        "",
        "What has to be said before any result; empty if nothing has to be. `samples` are the inputs that "
        "were sample recordings of the package.",
    )
    samples: list[str] = []
    instrument: str = item("", "Name of the instrument profile that was taken.")
    stages: dict[str, dict[str, Any]] = item(
        {}, "Sections of the finished stages by name; `of` returns one as its model."
    )
    error: str = item("", "What stopped the run; empty if nothing did.")

    def of(self, kind: type[Results]) -> Results:
        """Return the section of the stage of `kind`; all defaults without that stage.

        Raises `InputDataError` when the section is not that of the stage.
        """
        return _parsed(kind, self.stages.get(kind.stage, {}), f"results of stage '{kind.stage}'")


def results_of(kind: type[Results], product: Product) -> Results:
    """Return the results of a `product` as the model `kind` of its stage.

    Raises `InputDataError` when they are not those of the stage.
    """
    return _parsed(kind, product.results, f"results of stage '{product.stage}'")


def provenance_of(product: Product) -> Provenance:
    """Return the provenance of a `product`; `InputDataError` when it is damaged."""
    return _parsed(Provenance, product.provenance, f"provenance of stage '{product.stage}'")


def read_run_results(path: Path) -> RunResults:
    """Read the results.json at `path`; `InputDataError` when it is missing, or not the results of a run."""
    try:
        content = json.loads(read_regular(path))
    except (OSError, ValueError, RecursionError) as error:
        raise InputDataError(f"{path}: cannot be read ({error}); run the recipe again") from error
    return _parsed(RunResults, content, str(path))


def _parsed(kind: type[Part], content: Any, what: str) -> Part:
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "content"
        raise InputDataError(f"{what}: {key}: {first['msg']}; run the recipe again") from error


class Observed(ResultsPart):
    """How and when a recording was taken."""

    file: str = item("", "Name of the data file.")
    start: str = item("", "Time of the first frame, UTC, ISO 8601; empty where it is not known.")
    cards: dict[str, Any] = item({}, "Cards of the file's primary header that products inherit, by keyword.")
    instrument: str = item("", "Name of the instrument profile.")
    target: str = item("", "Name of the star.")
    mode: str = item("", "Read-out mode; empty where the layout has none.")
    exposure_s: Number = item(nan, "Exposure of a frame, and frames per second.")
    frame_rate_hz: Number = item(nan, DITTO)
    mag_j: Number = item(nan, "J magnitude of the star.")
    pixel_scale_mas: Number = item(nan, "Scale of the images, per pixel.")
    wavelength_nm: Number = item(nan, "Mean wavelength of the photons.")
    diversity_source: str = item("", "What introduced the diversity, such as ``lens``.")
    diversity_nm: ByNoll = item({}, "Introduced diversity by Noll index [nm RMS].")
    derotator_angle_deg: Number = item(nan, "Angles; NaN where they are not known.")
    parallactic_angle_deg: Number = item(nan, DITTO)
    altitude_deg: Number = item(nan, DITTO)
    pupil_rotation_deg: Number = item(nan, DITTO)


class Recorded(Observed):
    """The same with the place of the recording in a run."""

    name: str = ""
    input: str = ""
    role: str = ""
    frames: int = 0
    frames_rejected: int = 0
    window: tuple[int, ...] = ()


def recorded(provenance: Mapping[str, Any]) -> list[Recorded]:
    """Return the recordings that a product was made from, as its `provenance` lists them.

    Raises `InputDataError` when the list is damaged.
    """
    try:
        return [Recorded.model_validate(entry) for entry in provenance.get("recordings", ())]
    except (TypeError, ValidationError) as error:
        raise InputDataError("provenance: recordings cannot be read; run the recipe again") from error


# -- what the numbers mean ---------------------------------------------------------------------------

ELSEWHERE = re.compile(r"[,;]? see `[\w.]+`")  # where developers read on


def meaning_of(model: type[Any], key: str) -> str:
    """Return what a dotted `key` in results of a `model` means, in plain text; empty if nothing says so."""
    name, _, inner = key.partition(".")
    found = next(models_in(fields_of(model)[name]), None) if inner else None
    text = meaning_of(found, inner) if found else told_of(model).get(name, "")
    return ELSEWHERE.sub("", text).replace("`", "")


def fields_of(model: type[Any]) -> dict[str, Any]:
    """Return the annotations of what a `model` writes, by key: pydantic's, or a dataclass of science."""
    if issubclass(model, ResultsPart):
        return {key: field.annotation for key, field in model.model_fields.items()}
    hints = get_type_hints(model)
    return {field.name: hints[field.name] for field in fields(model)}


def told_of(model: type[Any]) -> dict[str, str]:
    """Return what the fields of a `model` mean, by name, as far as they say so."""
    if issubclass(model, ResultsPart):
        said = {name: field.description for name, field in model.model_fields.items()}
    else:
        said = {field.name: field.metadata.get("description") for field in fields(model)}
    found: dict[str, str] = {}
    above = ""
    for name, meaning in said.items():
        above = above if meaning == DITTO else meaning or ""
        found |= {name: above} if above else {}
    return found


def models_in(annotation: Any) -> Iterator[type]:
    """Yield the models that a field with this `annotation` may hold."""
    if isinstance(annotation, type) and (is_dataclass(annotation) or issubclass(annotation, ResultsPart)):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)
