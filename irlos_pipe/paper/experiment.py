"""What an experiment of the paper is: samples, the rows that come of each, tables, checks, a section.

An experiment is one module of this package. From top to bottom it states its sizes, what one sample is, how
the rows of a sample are measured, what they are summarised to, what this has to keep, and how it is shown.
It is a stage, so that a recipe runs it; `docs/extending.md` says how to add one. Experiments take what they
need of the pipeline from here.
"""

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from pydantic import AfterValidator

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.text import aligned
from irlos_pipe.paper.common.ensemble import run_samples
from irlos_pipe.paper.common.scenes import cube_scene
from irlos_pipe.paper.common.table import (
    Frame,
    Listing,
    Tables,
    check,
    checked,
    filled,
    frame,
    grouped,
    lines,
    median_in_range,
    rms_in_range,
    spreads,
    stacked,
    strips,
)  # fmt: skip
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.product.results import StageResults
from irlos_pipe.report.content import Block, Figure, Section
from irlos_pipe.report.run_data import RunData
from irlos_pipe.simulate.atmosphere import Shape
from irlos_pipe.simulate.scene import Scene
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput

__all__ = [
    "Blocks", "Check", "Context", "Drawn", "Experiment", "ExperimentResults", "Figure", "Frame", "Listing",
    "Quantity", "Rows", "Sample", "Samples", "StageConfig", "Tables", "check", "checked", "each", "frame",
    "grouped", "known", "lines", "median_in_range", "rms_in_range", "sample", "spreads", "stacked",
    "strips",
]  # fmt: skip
Context = StageContext[Any]
Rows = Iterator[dict[str, Any]]
Blocks = list[Block]
UNITS = {"nm": "nm", "arcsec": "arcsec", "mas": "mas", "deg": "deg", "s": "s", "e": "e-", "j": "mag"}


@dataclass(frozen=True)
class Sample:
    """What one worker computes, and all that its rows depend on."""

    name: str  # for messages, and the column ``sample`` of its rows
    seed: tuple[int, ...]
    facility: Facility
    sizes: Any  # the settings of the experiment
    of: Mapping[str, Any] = field(default_factory=dict)  # its own; numbers and texts are columns of its rows

    def __getitem__(self, key: str) -> Any:
        return self.of[key]

    def cube(
        self,
        seeing_arcsec: float,
        frames: int,
        mag_j: float,
        shape: Shape = "power_law",
        *,
        without: Container[int] = (),
        **changes: Any,
    ) -> Scene:
        """Return a cube, see `cube_scene`; its NCPAs are `without` some modes, `changes` are of the scene."""
        cube = cube_scene(self.name, self.seed, self.facility, seeing_arcsec, frames, mag_j, shape)
        kept_nm = {noll: value for noll, value in cube.ncpa_nm.items() if noll not in without}
        return replace(cube, **{"ncpa_nm": kept_nm} | changes)


Samples = Iterator[Sample]


def sample(ctx: Context, name: str, *seed: int, **of: Any) -> Sample:
    """Return a sample of the experiment that `ctx` runs; its seed begins with that of the recipe."""
    return Sample(name, (ctx.seed, *seed), ctx.instrument.facility, ctx.config, of)


def each(ctx: Context, count: int, name: str, **of: Any) -> Samples:
    """Yield samples with their ``index`` as seed; `name` is a pattern for it and for what they have."""
    for index in range(count):
        yield sample(ctx, name.format(index=index, **of), index, **of)


def known(names: Iterable[str], what: str) -> AfterValidator:
    """Return the check of a setting that it lists `names` only; `what` says in messages what they are."""

    def checked(given: tuple[str, ...]) -> tuple[str, ...]:
        for name in given:
            if name not in names:
                raise ValueError(f"no {what} '{name}'; known: {', '.join(names)}")
        return given

    return AfterValidator(checked)


class ExperimentResults(StageResults):
    """Tables of an experiment by name, each a list of rows."""

    tables: dict[str, list[dict[str, Any]]] = {}

    def frames(self) -> dict[str, Frame]:
        return {name: frame(rows) for name, rows in self.tables.items()}


@dataclass(frozen=True)
class Drawn:
    """What the figures of an experiment are drawn from: its tables, and rows and arrays of its product."""

    run: RunData
    stage: str
    tables: Tables

    @property
    def sizes(self) -> Mapping[str, Any]:
        return self.run.products[self.stage].config

    def array(self, name: str) -> np.ndarray:
        """Return an array of the product, which must be there."""
        return np.asarray(self.run.products[self.stage].arrays[name].value)

    def rows(self) -> Frame:
        """Return the numbers and texts of the rows of all samples."""
        names = [name for name in self.run.products[self.stage].arrays if name.startswith("rows/")]
        columns = {name.removeprefix("rows/"): self.array(name) for name in names}
        return frame(
            dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)
        )


@dataclass(frozen=True)
class Experiment:
    """An experiment as a stage of a recipe; `docs/extending.md` says what its parts state.

    Samples are what the workers compute, as many `unit`; `rows` are computed there. `tables` come from a
    frame of the rows of all samples, checks from the tables, and quantities for the product, next to the
    numbers and texts of the rows, from `arrays`. The report has `lead`, a pattern for the first row of the
    first table, the figures, and the listings, of which the first is shown on the terminal as well.
    """

    NAME: str
    VERSION: int
    Config: type[StageConfig]
    title: str
    samples: Callable[[Context], Iterable[Sample]]
    rows: Callable[[Sample], Iterable[Mapping[str, Any]]]
    tables: Callable[[Frame, Context], Tables]
    checks: Callable[[Tables], Sequence[Check]]
    listings: Sequence[Listing]
    figures: Callable[[Drawn], Sequence[Block]]
    lead: str
    unit: str = "samples"
    arrays: Callable[[Frame, Context], Mapping[str, Quantity]] | None = None
    Results: type[ExperimentResults] = field(init=False)
    DEPENDS_ON: ClassVar[tuple[str, ...]] = ("instrument", "seed")

    def __post_init__(self) -> None:
        text = f"Tables of the experiment `{self.NAME}`."
        own = {"stage": self.NAME, "__module__": __name__, "__doc__": text}
        object.__setattr__(self, "Results", type(f"{self.NAME}_results", (ExperimentResults,), own))

    def run(self, ctx: Context) -> StageOutput:
        samples = list(self.samples(ctx))
        rows = frame(
            {"sample": one.name}
            | {key: value for key, value in one.of.items() if isinstance(value, (str, bool, int, float))}
            | row
            for one, own in zip(samples, run_samples(self.rows, samples, ctx, self.unit), strict=True)
            for row in own
        )
        tables = self.tables(rows, ctx)
        arrays = {
            f"rows/{name}": Quantity(_array(column), UNITS.get(name.rpartition("_")[2], ""), "of every row")
            for name, column in rows.items()
            if not any(isinstance(value, np.ndarray) for value in column)
        } | dict(self.arrays(rows, ctx) if self.arrays else {})
        results = self.Results(tables={name: table.to_dict("records") for name, table in tables.items()})
        first = self.listings[0].table(tables, ranges=False)
        summary = aligned([first.columns, *first.rows]).splitlines()
        return StageOutput(arrays, results, self.checks(tables), summary=summary)

    def checks_of(self, results: ExperimentResults) -> Sequence[Check]:
        """Return the checks of results, which may be older than these checks."""
        return self.checks(results.frames())

    def section(self, run: RunData) -> Section:
        tables = run.results(self.Results).frames()
        shown = [listing.table(tables) for listing in self.listings if len(tables.get(listing.of, ()))]
        blocks = [*self.figures(Drawn(run, self.NAME, tables)), *shown]
        first = next(iter(tables.values())).to_dict("records")[0] if tables else {}
        return Section(self.NAME, self.title, filled(self.lead, first), blocks)


def _array(column: Frame) -> np.ndarray:
    if column.dtype.kind in "biuf":
        return np.asarray(column)
    return np.array(["" if value != value else str(value) for value in column], dtype=object)
