"""What the report reads: the products of a run and its files for scripts."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.json import canonical_json
from irlos_pipe.files.regular import read_regular
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.results import Results, RunResults, read_run_results, results_of
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import open_product
from irlos_pipe.report.content import Block, Blocks, shown
from irlos_pipe.stages.ingest.stage import Overview, overviews_from_product

Key = TypeVar("Key")


class Absent(Exception):
    """A product lacks what a block is drawn from, and the block is left out."""


@dataclass(frozen=True)
class RunData:
    """A finished run, or what there is of it."""

    recipe: dict[str, Any]  # the resolved recipe; `recipe_text` is its file
    recipe_text: str
    outcome: RunResults  # content of results.json: status, error, notice, instrument
    # By stage name, in the order of the recipe; their arrays are read when they are asked for.
    products: dict[str, Product]
    recordings: list[Overview]  # what ingest left, without frames; empty without ingest
    files: Mapping[str, str] = field(default_factory=dict)  # names of the files of the products, by stage

    def results(self, kind: type[Results]) -> Results:
        """Return the results of a stage as the model `kind`; all defaults without that stage."""
        return results_of(kind, self.products[kind.stage]) if kind.stage in self.products else kind()

    def of(self, kind: type[Results]) -> "StageData[Results]":
        """Return what there is of the stage whose results are of a `kind`."""
        return StageData(self, kind.stage, self.results(kind))


@dataclass(frozen=True)
class StageData(Generic[Results]):
    """What a section shows of one stage of a run."""

    run: RunData
    stage: str
    results: Results

    @property
    def arrays(self) -> Mapping[str, Quantity]:
        """Arrays of the product; none if the stage was not run."""
        return self.run.products[self.stage].arrays if self.stage in self.run.products else {}

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the array `name` of the product.

        Raises `Absent` where there is none.
        """
        if name not in self.arrays:
            raise Absent(f"{self.stage}: {name}")
        return np.asarray(self.arrays[name].value)

    def known(self, names: Mapping[Key, str]) -> dict[Key, np.ndarray]:
        """Return those of some arrays that are there, given by a key for each.

        Raises `Absent` where there is none of them.
        """
        found = {key: self[name] for key, name in names.items() if name in self.arrays}
        if not found:
            raise Absent(f"{self.stage}: {', '.join(names.values())}")
        return found

    def error_of(self, name: str) -> np.ndarray | None:
        """Return the standard error of the array `name`, or None where it has none."""
        return self.arrays[name].error if name in self.arrays else None

    def blocks(self, *parts: "Callable[[StageData[Results]], Blocks]") -> list[Block]:
        """Return what each of the `parts` makes of this stage, without those that lack their arrays."""
        found: list[Block] = []
        for part in parts:
            with suppress(Absent):
                found += shown(part(self))
        return found

    @property
    def recordings(self) -> list[Overview]:
        product = self.run.products.get(self.stage)
        requested = product.config.get("input") if product else None
        return [recording for recording in self.run.recordings if recording.input == requested]

    @property
    def pixel_scale_mas(self) -> float | None:
        """Pixel scale of these recordings; None where it is not known."""
        return next((one.acquisition.pixel_scale_mas for one in self.recordings), None)


def frame_times(recordings: Sequence[Overview]) -> tuple[np.ndarray, float]:
    """Return the times of the used frames from the first recording on [s], and frames per second.

    Recordings whose time is not known follow one another; the rate is NaN without a clock.
    """
    found, begin, rate = [], 0.0, np.nan
    for one in recordings:
        step = float(np.median(np.diff(one.time_s))) if len(one.time_s) > 1 else 0.0
        rate = 1 / step if step > 0 else rate
        start = one.start_unix_s - recordings[0].start_unix_s
        found.append(one.time_s[one.used] + (start if np.isfinite(start) else begin))
        begin = float(np.max(found[-1], initial=begin)) + step
    return np.concatenate(found or [[]]), rate


def _own_product(path: Path, stage: str, results: RunResults) -> Product:
    """Open a product that results.json speaks of; one of another run is refused."""
    product = open_product(path)
    if product.stage != stage or canonical_json(product.results) != canonical_json(results.stages[stage]):
        raise InputDataError(f"{path}: not the product that results.json was made from; run the recipe again")
    return product


def read_run(folder: Path) -> RunData:
    """Read a run folder.

    Raises `InputDataError` when it is not the folder of a run, or a file of it cannot be read.
    """
    run = existing_run(folder)
    results = read_run_results(run.results)
    paths = run.products()
    products = {stage: _own_product(path, stage, results) for stage, path in paths.items()}
    return RunData(
        load_yaml(run.recipe, InputDataError)[0],
        read_regular(run.recipe),
        results,
        products,
        overviews_from_product(products["ingest"]) if "ingest" in products else [],
        {stage: path.name for stage, path in paths.items()},
    )
