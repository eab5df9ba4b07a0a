"""What the report reads: the products of a run and its files for scripts."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.frames.recording import Recording
from irlos_pipe.product.product import Product, read_product
from irlos_pipe.product.results import Results, results_of
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.stages.ingest.recordings import recordings_from_product


@dataclass(frozen=True)
class RunData:
    """A finished run, or what there is of it.

    Attributes
    ----------
    recipe : dict
        The resolved recipe; `recipe_text` is the file.
    status, error : str
        As in results.json.
    products : dict of str to Product
        By stage name, in the order of the recipe.
    recordings : list of Recording
        As ingest left them; empty without ingest.
    """

    recipe: dict[str, Any]
    recipe_text: str
    status: str
    error: str
    products: dict[str, Product]
    recordings: list[Recording]

    @overload
    def results(self, stage: type[Results]) -> Results: ...
    @overload
    def results(self, stage: str) -> dict[str, Any]: ...

    def results(self, stage: type[Results] | str) -> Results | dict[str, Any]:
        """Return the results of a stage as its model; all defaults without that stage."""
        if isinstance(stage, str):
            return self.products[stage].results if stage in self.products else {}
        return results_of(stage, self.products[stage.stage]) if stage.stage in self.products else stage()

    def array(self, stage: str, name: str) -> np.ndarray | None:
        """Return an array of a product, or None where there is none."""
        quantity = self.products[stage].arrays.get(name) if stage in self.products else None
        return None if quantity is None else np.asarray(quantity.value)

    def error_of(self, stage: str, name: str) -> np.ndarray | None:
        """Return the 1-sigma error of an array of a product, or None where there is none."""
        quantity = self.products[stage].arrays.get(name) if stage in self.products else None
        return None if quantity is None else quantity.error

    def recordings_of(self, stage: str) -> list[Recording]:
        """Return the recordings of the recipe input that a stage works on."""
        wanted = self.products[stage].config.get("input") if stage in self.products else None
        return [recording for recording in self.recordings if recording.input == wanted]

    def pixel_scale_mas(self, stage: str) -> float | None:
        """Return the pixel scale of the recordings a stage works on; None where it is not known."""
        return next((r.acquisition.pixel_scale_mas for r in self.recordings_of(stage)), None)


def read_run(folder: Path) -> RunData:
    """Read a run folder.

    Raises
    ------
    InputDataError
        When it is not the folder of a run, or a file of it cannot be read.
    """
    run = existing_run(folder)
    products = {stage: read_product(path) for stage, path in run.products().items()}
    told = json.loads(run.results.read_text())
    recipe = load_yaml(run.recipe, InputDataError)[0]
    return RunData(
        recipe,
        run.recipe.read_text(),
        told.get("status", ""),
        told.get("error", ""),
        products,
        _recordings(products.get("ingest")),
    )


def _recordings(ingest: Product | None) -> list[Recording]:
    holds_some = ingest is not None and any(name.endswith("/images_e") for name in ingest.arrays)
    return recordings_from_product(ingest) if holds_some else []
