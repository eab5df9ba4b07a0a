"""What a stage is: the contract between the pipeline and the modules in this package.

Also the section `model` of a recipe: the PSF model that calibrate, lift, sensitivity and correct share.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Generic, Literal, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.declaration import Public
from irlos_pipe.product.product import Check, Product, Quantity
from irlos_pipe.product.results import StageResults, item, results_of
from irlos_pipe.product.table import Table

if TYPE_CHECKING:
    from irlos_pipe.frames.recording import Recording
    from irlos_pipe.instrument.instrument import Instrument

FIT = "fit"


@dataclass(frozen=True)
class EffectEntry:
    """An effect as a recipe asks for it."""

    name: str
    values: dict[str, Any]  # public values it is held at, or starts from; empty if estimated from scratch
    options: dict[str, Any]
    fit: bool  # whether it is estimated all the same

    @classmethod
    def of(cls, entry: Any) -> EffectEntry:
        """From ``name`` or ``{name: {key: value}}``; `ValueError` says what is wrong and what is allowed."""
        name, given = entry, dict[str, Any]()
        if isinstance(entry, dict) and len(entry) == 1:
            name, given = next(iter(entry.items()))
        if not isinstance(name, str) or name not in CATALOGUE:
            raise ValueError(f"unknown effect {name!r}{suggestion(name, CATALOGUE)}")
        effect = CATALOGUE[name]
        if not isinstance(given, dict):
            raise ValueError(f"{name} is fixed by {_keys(effect.public)}, not by {given!r}")
        options = {o.name: given[o.name] for o in effect.options if o.name in given}
        values = {p.name: given[p.name] for p in effect.public if p.name in given}
        unknown = sorted(set(given) - {*options, *values, FIT})
        missing = [p.name for p in effect.public if values and p.required and p.name not in values]
        if unknown or missing:
            others = f"; options: {_keys(effect.options)}" if effect.options else ""
            raise ValueError(f"{name} is fixed by {_keys(effect.public)}, not by {given!r}{others}")
        for public in (*effect.public, *effect.options):
            if public.name in given:
                _check(f"{name}.{public.name}", public, given[public.name])
        if values:
            effect.options_for(**values)  # refuses values that do not fit together
        return cls(name, values, options, not values or bool(given.get(FIT, False)))


def _keys(publics: tuple[Public, ...]) -> str:
    return "{" + ", ".join(p.name if p.required else f"[{p.name}]" for p in publics) + "}"


Real = Annotated[float, Field(strict=True)]
Whole = Annotated[int, Field(strict=True, ge=0)]
Noll = Annotated[int, Field(strict=True, ge=1)]
SOME = Field(min_length=1)
# What a value of each kind is, and how that is said.
SHAPES: Mapping[str, tuple[Any, str]] = {
    "number": (Real, "a number"),
    "word": (Annotated[str, Field(strict=True)], "a word"),
    "zernike": (Annotated[dict[Noll, Real], SOME], "a table {Noll index: value}"),
    "parts": (Annotated[Sequence[Real], SOME], "a list of numbers"),
    "pixels": (Annotated[Sequence[tuple[Whole, Whole]], SOME], "a list of [row, column]"),
    "nolls": (Annotated[Sequence[Noll], SOME], "a list of Noll indices"),
}


def _check(label: str, public: Public, value: Any) -> None:
    """Raise ValueError unless `value` is of the kind and within the limits of `public`."""
    try:
        _shape(public.kind).validate_python(value)
    except ValidationError:
        raise ValueError(f"{label} must be {SHAPES[public.kind][1]}, not {value!r}") from None
    if public.choices and value not in public.choices:
        raise ValueError(f"{label} must be {' or '.join(public.choices)}, not {value!r}")
    inner = {"number": lambda: [value], "zernike": lambda: value.values(), "parts": lambda: value}
    numbers = inner[public.kind]() if public.kind in inner else ()
    if not all(public.lower <= number <= public.upper for number in numbers):
        between = f"lie between {public.lower:g} and {public.upper:g}"
        not_negative = public.lower == 0 and public.upper == float("inf")
        raise ValueError(f"{label} must {'not be negative' if not_negative else between}, not {value!r}")


@cache
def _shape(kind: str) -> TypeAdapter[Any]:
    return TypeAdapter(SHAPES[kind][0])


class ModelConfig(BaseModel):
    """What the PSF model contains.

    An effect is named to be estimated (``seeing_halo``), given with its parameters to be held at them
    (``tip_tilt_jitter: {sigma_mas: 8}``), or to be estimated from there (the same and ``fit: true``).
    Some have options besides (``vibration: {shape: gaussian}``). Several companions, phase bumps or biases
    of parts of a ramp are listed one by one; results name the second ``companion_2``.
    """

    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True)

    effects: tuple[Annotated[Any, Field()], ...] = item(
        ("seeing_halo", "tip_tilt_jitter"),
        "effects beyond the static wavefront, by name, or {name: {parameter: value}} to fix one",
    )
    colour: Literal["auto", "listed"] = item(
        "auto",
        "auto: atmospheric dispersion and the star's colour belong to the model of calibrate and "
        "lift where the band is broad and there is an AO residual; listed: only what effects lists",
    )
    pupil_samples: int = item(128, "samples across the pupil diameter", ge=48, le=512)
    cutoff_per_m: float | None = item(
        None, "AO cut-off, 1/(2 actuator pitch) [1/m]; that of the instrument if left out", ge=0.01, le=1000
    )
    outer_scale_m: float | None = item(
        None, "outer scale of the turbulence [m]; the instrument's if left out", gt=1, le=1000
    )

    @field_validator("effects", mode="after")
    @classmethod
    def _known_effects(cls, effects: tuple) -> tuple:
        names = [EffectEntry.of(entry).name for entry in effects]
        again = sorted({name for name in names if names.count(name) > 1 and not CATALOGUE[name].repeatable})
        if again:
            raise ValueError(f"an effect is listed twice: {', '.join(again)}")
        return effects

    def completed(self, facility: Facility) -> ModelConfig:
        """Return the section with what it leaves out taken from the `facility`."""
        absent = [name for name in ("cutoff_per_m", "outer_scale_m") if getattr(self, name) is None]
        return self.model_copy(update={name: getattr(facility, name) for name in absent})

    def entries(self) -> list[EffectEntry]:
        return [EffectEntry.of(entry) for entry in self.effects]


KEY_PARTS = frozenset({"model", "instrument", "seed", "inputs"})
# What a stage need not declare, see `Stage`.
DEFAULTS: dict[str, Any] = {
    "NEEDS": (), "READS": (), "ARRAYS_ONLY": False, "DEPENDS_ON": KEY_PARTS, "files_of": None,
}  # fmt: skip


class StageConfig(BaseModel):
    """Base of every stage's section of a recipe: unknown keys are errors, values do not change."""

    model_config: ClassVar[ConfigDict] = ConfigDict(defer_build=True, extra="forbid", frozen=True)


ConfigT = TypeVar("ConfigT", bound=StageConfig)


@dataclass(frozen=True)
class StageContext(Generic[ConfigT]):
    """Everything a stage may use; ``StageContext[Config]`` states whose section `config` is."""

    config: ConfigT  # the stage's own section of the recipe
    model: ModelConfig
    instrument: Instrument
    inputs: dict[str, tuple[Path, ...]]  # input files and folders by the recipe's input names
    products: dict[str, Product]  # of the earlier stages by stage name, as read from disk
    device: str  # ``cpu`` or ``cuda``
    seed: int
    jobs: int  # number of threads or processes to use
    # ``progress(iterable=None, total=None, desc="")``, tqdm-like; silent unless on a terminal
    progress: Callable[..., Any]
    log: logging.Logger  # goes to run.log and into the product; shown on the terminal with ``-v``
    # Folder for finished parts of a long stage, made by the stage itself. It survives an interruption, stays
    # the same while nothing changes that the product depends on, and is removed when the product is written.
    scratch: Path


@dataclass(frozen=True)
class Declared(Generic[ConfigT]):
    """What is known of the input of a stage before a frame is looked at."""

    config: ConfigT
    model: ModelConfig
    instrument: Instrument
    recordings: Sequence[Recording]  # of the input that `config` names, at least one; their images are dark


@dataclass(frozen=True)
class StageOutput:
    """What a stage returns."""

    arrays: dict[str, Quantity]
    results: StageResults  # the stage's section of results.json
    checks: Sequence[Check] = ()
    # Further files for the run folder, by name; a table is written with its origin in the header.
    files: dict[str, bytes | Table] = field(default_factory=dict)
    summary: Sequence[str] = ()  # lines for the table on the terminal
    failures: Sequence[str] = ()  # one line per failed exposure while others succeed: the run is partial


class Stage(Protocol):
    """The module of a stage: what can stand in a recipe.

    It may further define

    - ``ARRAYS`` and ``CHECKS``: the arrays of its product and its checks, see `product.product`;
    - ``NEEDS``: names of stages that must come before it in a recipe (default none);
    - ``READS``: names of further stages whose products it looks at if they come before it (default
      none). A change of any other stage does not redo it;
    - ``files_of(root)``: the files of an input, given as a file or folder, that it reads (default all
      of them). Other files may change without its product being made again;
    - ``examined(inputs, config, instrument)``: a line for everything that is wrong with the files of the
      inputs, found without running the stage, and the recordings as they are declared;
    - ``require(declared)``: raises what ``run`` would raise of recordings that are `Declared` so;
    - ``DEPENDS_ON``: the parts of `KEY_PARTS` it depends on (default all of them). A change of
      any other part does not redo it;
    - ``ARRAYS_ONLY``: True if it needs no PyTorch, for which it does not wait;
    - ``checks_of(results)``: the checks of its results, by which an experiment's numbers are judged again
      where they are collected: they may be older than the checks.
    """

    VERSION: int  # raised where its products change
    Config: type[StageConfig]  # its section of a recipe
    Results: type[StageResults]  # its section of results.json, which has its name

    @staticmethod
    def run(ctx: StageContext[Any]) -> StageOutput:
        """Do the work of the stage."""
        ...


@contextmanager
def refused(kind: type[IrlosError], place: str, advice: str = "") -> Iterator[None]:
    """Turn a `ValueError` of science into an error of a `kind`, of what is at a `place`, with `advice`."""
    try:
        yield
    except ValueError as problem:
        raise kind(f"{place}: {problem}{advice}") from None


def late(module: str, name: str = "run") -> Callable[..., Any]:
    """Return the function `name` of a `module` that is imported when it is called, as for PyTorch."""
    return lambda *given: getattr(import_module(module), name)(*given)


def declared_by(stage: Stage, name: str) -> Any:
    """Return what a `stage` declares under a `name` of `DEFAULTS`, or that default."""
    return getattr(stage, name, DEFAULTS[name])


def reads(stage: Stage, earlier: Sequence[str]) -> tuple[str, ...]:
    """Return the names of those of the `earlier` stages whose products `stage` reads."""
    wanted = (*declared_by(stage, "NEEDS"), *declared_by(stage, "READS"))
    return tuple(name for name in earlier if name in wanted)


def judged(stage: Stage, product: Product) -> Sequence[Check]:
    """Return the checks of the `product` of a `stage`, as the stage makes them today if it says how."""
    checks_of = getattr(stage, "checks_of", None)
    return product.checks if checks_of is None else checks_of(results_of(stage.Results, product))
