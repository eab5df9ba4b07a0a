"""What a stage is: the contract between the pipeline and the modules in this package."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict

from irlos_pipe.product.product import Check, Product, Quantity
from irlos_pipe.product.results import StageResults, results_of
from irlos_pipe.product.table import Table

if TYPE_CHECKING:
    from irlos_pipe.frames.recording import Recording
    from irlos_pipe.instrument.instrument import Instrument
    from irlos_pipe.stages.model.section import ModelConfig

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


def run_of(module: str) -> Callable[[StageContext[Any]], StageOutput]:
    """Return the function `run` of a `module` that is imported when the stage runs, as for PyTorch."""
    return lambda ctx: import_module(module).run(ctx)


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
