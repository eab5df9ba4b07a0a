"""What the report reads: the products of a run and its files for scripts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.json import canonical_json
from irlos_pipe.files.regular import read_regular
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import Results, RunResults, read_run_results, results_of
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import open_product
from irlos_pipe.stages.ingest.recording_arrays import Overview, overviews_from_product


@dataclass(frozen=True)
class RunData:
    """A finished run, or what there is of it.

    Attributes
    ----------
    recipe : dict
        The resolved recipe; `recipe_text` is its file.
    status, error, notice : str
        As in results.json.
    products : dict of str to Product
        By stage name, in the order of the recipe; their arrays are read when they are asked for.
    recordings : list of Overview
        What ingest left, without frames; empty without ingest.
    """

    recipe: dict[str, Any]
    recipe_text: str
    status: str
    error: str
    notice: str
    products: dict[str, Product]
    recordings: list[Overview]

    def results(self, kind: type[Results]) -> Results:
        """Return the results of a stage as the model `kind`; all defaults without that stage."""
        return results_of(kind, self.products[kind.stage]) if kind.stage in self.products else kind()

    def array(self, stage: str, name: str) -> np.ndarray | None:
        """Return the array `name` of the product of `stage`, or None where there is none."""
        quantity = self.products[stage].arrays.get(name) if stage in self.products else None
        return None if quantity is None else np.asarray(quantity.value)

    def error_of(self, stage: str, name: str) -> np.ndarray | None:
        """Return the 1-sigma error of the array `name` of the product of `stage`, or None if it has none."""
        quantity = self.products[stage].arrays.get(name) if stage in self.products else None
        return None if quantity is None else quantity.error

    def recordings_of(self, stage: str) -> list[Overview]:
        """Return the recordings of the recipe input that a stage works on."""
        wanted = self.products[stage].config.get("input") if stage in self.products else None
        return [recording for recording in self.recordings if recording.input == wanted]

    def pixel_scale_mas(self, stage: str) -> float | None:
        """Return the pixel scale of the recordings a stage works on; None where it is not known."""
        return next((r.acquisition.pixel_scale_mas for r in self.recordings_of(stage)), None)


def _own_product(path: Path, stage: str, results: RunResults) -> Product:
    """Open a product that results.json speaks of; one of another run is refused."""
    product = open_product(path)
    if product.stage != stage or canonical_json(product.results) != canonical_json(results.stages[stage]):
        raise InputDataError(f"{path}: not the product that results.json was made from; run the recipe again")
    return product


def read_run(folder: Path) -> RunData:
    """Read a run folder.

    Raises
    ------
    InputDataError
        When it is not the folder of a run, or a file of it cannot be read.
    """
    run = existing_run(folder)
    results = read_run_results(run.results)
    products = {stage: _own_product(path, stage, results) for stage, path in run.products().items()}
    recipe = load_yaml(run.recipe, InputDataError)[0]
    return RunData(
        recipe,
        read_regular(run.recipe),
        results.status,
        results.error,
        results.notice,
        products,
        overviews_from_product(products["ingest"]) if "ingest" in products else [],
    )
